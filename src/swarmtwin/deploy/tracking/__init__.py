"""From pictures to poses in the arena."""
