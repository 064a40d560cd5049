"""The generators: one file a generator, found by its name; each ends in the class `Config` that types its YAML."""
