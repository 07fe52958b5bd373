"""Projector, camera and robot: backends as siblings behind one face each, imported only when they are named."""
