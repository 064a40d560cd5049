"""The causes of the catalogue (DESIGN section 8), one file each, found by its name."""
