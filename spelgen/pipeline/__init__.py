"""From a URDF to a module: load the arm, derive its structure, plan the model, write it."""
