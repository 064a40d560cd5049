"""The dynamics models: one file a model, found by its name; each ends in the class `Config` that types its YAML."""
