"""The tasks: one file a kind, found by its name; each ends in the class `Config` that types its YAML."""
