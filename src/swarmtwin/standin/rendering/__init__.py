"""What an overhead camera sees of a scene, computed."""
