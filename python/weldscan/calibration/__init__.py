"""What ties the numbers to the world: the three-sphere artefact and the hand-eye transform."""
