"""Pictures and when they were taken."""
