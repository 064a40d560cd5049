"""Emulated robots: stand-ins with firmware on a real broker, under a camera that renders them."""
