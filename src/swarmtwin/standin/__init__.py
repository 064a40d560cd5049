"""Stand-ins: physics models of robots that play the real ones where none is at hand."""
