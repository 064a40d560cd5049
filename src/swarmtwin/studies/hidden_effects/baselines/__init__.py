"""What else there is to diagnose with: methods to compare with, none of which the diagnosis uses."""
