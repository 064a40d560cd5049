"""The learning algorithms: one file each, found by its name; each ends in the class `Config` that types its YAML."""
