"""From a policy to the robots and back: a camera sees them, a controller commands them, a recording results."""
