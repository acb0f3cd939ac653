"""Measurements of pose networks joined with features, by a network whose errors are known."""
