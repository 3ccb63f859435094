"""The command line `spelgen`."""
