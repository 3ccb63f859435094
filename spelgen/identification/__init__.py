"""Linear least squares on logs: base parameters, torque delay, couplings of motors, tests of a log's geometry."""
