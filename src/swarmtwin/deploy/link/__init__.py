"""Commands on their way to the robots."""
