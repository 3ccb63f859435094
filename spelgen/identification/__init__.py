"""Linear least squares on logs: base parameters, torque delay, couplings of motors, faults of a log's columns."""
