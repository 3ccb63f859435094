"""Logs: read, doubted, filtered, cut into windows."""
