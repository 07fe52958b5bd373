"""The simulated cell, its devices and controllers, and scenes with their truth: nothing but faces and tests knows them.

`simulate_session` writes a session of the cell (docs/simulator.md), `scenes` draws welds as real pipes have them.
"""

from weldscan.simulated.cell import DEFAULT, BoardCell, Cell
from weldscan.simulated.placing import look_at, make_scanner, placed, tilted_views
from weldscan.simulated.session import render, session_document, simulate_session
from weldscan.simulated.shapes import (
    ANODISED,
    BEAD,
    CERAMIC,
    NO_BEAD,
    OTHER_WALL,
    PAPER,
    PLATE,
    REFERENCE_WALL,
    SPHERE,
    STEEL,
    STEM,
    Bead,
    Block,
    Body,
    Photometry,
    Sphere,
    Stem,
    Surface,
    Wall,
    Weld,
    pipe,
    plates,
)

__all__ = [
    "ANODISED",
    "BEAD",
    "CERAMIC",
    "DEFAULT",
    "NO_BEAD",
    "OTHER_WALL",
    "PAPER",
    "PLATE",
    "REFERENCE_WALL",
    "SPHERE",
    "STEEL",
    "STEM",
    "Bead",
    "Block",
    "BoardCell",
    "Body",
    "Cell",
    "Photometry",
    "Sphere",
    "Stem",
    "Surface",
    "Wall",
    "Weld",
    "look_at",
    "make_scanner",
    "pipe",
    "placed",
    "plates",
    "render",
    "session_document",
    "simulate_session",
    "tilted_views",
]
