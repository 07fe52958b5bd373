"""A flat board seen by a scanner under fringes, drawn with NumPy alone: an oracle for calibrations through images.

Every camera pixel's ray is cut with the board's plane: there the board's picture and the projector's pixel are read.
"""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from weldscan import Lens, Scanner
from weldscan.calibration.board import Board

FRINGES = (("x", 1, 3), ("x", 16, 3), ("y", 1, 3), ("y", 10, 3))
DOTS_PER_MM = 10


def small_scanner() -> Scanner:
    """640x480 and 640x400 pixels, wide lenses, 20 degrees apart at 400 mm."""
    camera = Lens(640, 480, [[900, 0, 322.3], [0, 901, 236.1], [0, 0, 1]], [-0.09, 0.07, 0.0004, -0.0006])
    projector = Lens(640, 400, [[820, 0, 318.2], [0, 819, 251.4], [0, 0, 1]], [0.03, -0.02, 0.0003, 0.0002])
    angle = np.radians(20)
    relation = np.eye(4)
    relation[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    relation[:3, 3] = [-400 * np.sin(angle), 5.0, 400 * (1 - np.cos(angle))]
    return Scanner(camera, projector, relation)


def views(count: int, distance_mm: float = 400.0) -> list[np.ndarray]:
    """camera_from_board: tilted by 25 to 40 degrees to all sides, turned, near and far, all over the image."""
    poses = []
    for i in range(count):
        around, tilt = 2.4 * i, np.radians((28.0, 38.0, 33.0, 24.0)[i % 4])
        turn = cv2.Rodrigues(np.array([np.cos(around), np.sin(around), 0.0]) * tilt)[0]
        roll = cv2.Rodrigues(np.array([0, 0, (0.2, 1.7, -0.4, 3.0)[i % 4]]))[0]
        pose = np.eye(4)
        pose[:3, :3] = turn @ roll
        pose[:3, 3] = [25 * np.cos(1.3 * i), 18 * np.sin(2.1 * i), distance_mm + (0, 25, -20)[i % 3]]
        poses.append(pose)
    return poses


def picture(board: Board) -> tuple[np.ndarray, float]:
    """The board's face, 0 to 255, DOTS_PER_MM, its middle where its features' middle is; and the reach of it in mm."""
    points = board.points_mm()[:, :2]
    reach = np.abs(points).max(axis=0) + 2.5 * board.pitch_mm
    width, height = np.ceil(2 * reach * DOTS_PER_MM).astype(int)
    x, y = (np.arange(width) + 0.5) / DOTS_PER_MM - reach[0], (np.arange(height) + 0.5) / DOTS_PER_MM - reach[1]
    x, y = np.meshgrid(x, y)
    if board.kind == "chessboard":
        corner = points.min(axis=0)
        column, row = np.floor((x - corner[0]) / board.pitch_mm), np.floor((y - corner[1]) / board.pitch_mm)
        inside = (column >= -1) & (column < board.columns) & (row >= -1) & (row < board.rows)
        face = np.where(inside & ((column + row) % 2 == 0), 60.0, 230.0)
    elif board.kind == "charuco":
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{board.dictionary or '4X4_1000'}"))
        made = cv2.aruco.CharucoBoard((board.columns, board.rows), board.pitch_mm, board.second_mm, dictionary)
        size = np.array([board.columns, board.rows]) * board.pitch_mm * DOTS_PER_MM
        drawn = made.generateImage(tuple(size.astype(int).tolist()))
        face = np.full(x.shape, 230.0)
        left, top = ((np.array(x.shape[::-1]) - size) / 2).astype(int)
        face[top : top + drawn.shape[0], left : left + drawn.shape[1]] = np.where(drawn > 127, 230.0, 60.0)
    else:
        face = np.full(x.shape, 230.0)
        for point in points:
            face[np.hypot(x - point[0], y - point[1]) < board.second_mm / 2] = 60.0
    return face.astype(np.float32), float(reach[0])


def render(
    scanner: Scanner,
    camera_from_board: np.ndarray,
    board: Board,
    fringes=FRINGES,
    *,
    light: float = 0.85,
    noise: float = 0.6,
    blur_px: float = 0.0,
    seed: int = 0,
) -> list[np.ndarray]:
    """The images of one pose, in the order of the fringes, 8 bits."""
    camera, projector = scanner.camera, scanner.projector
    share = 2  # samples along each side of a pixel
    at = (np.arange(camera.width * share) + 0.5) / share - 0.5, (np.arange(camera.height * share) + 0.5) / share - 0.5
    pixels = np.stack(np.meshgrid(*at), axis=-1).reshape(-1, 2)
    rays = np.column_stack([camera.undistort(pixels), np.ones(len(pixels))])
    normal, origin = camera_from_board[:3, 2], camera_from_board[:3, 3]
    points = rays * ((normal @ origin) / (rays @ normal))[:, None]
    on_board = (points - origin) @ camera_from_board[:3, :3]
    face, reach = picture(board)
    reach_y = face.shape[0] / DOTS_PER_MM / 2
    where = np.stack([on_board[:, 0] + reach, on_board[:, 1] + reach_y], axis=-1) * DOTS_PER_MM - 0.5
    shape = camera.height * share, camera.width * share
    x, y = (where[:, i].reshape(shape).astype(np.float32) for i in (0, 1))
    albedo = cv2.remap(face, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=20.0) / 255
    seen = scanner.project_to_projector(points)
    lit = ((seen >= -0.5) & (seen <= np.array([projector.width, projector.height]) - 0.5)).all(axis=1).reshape(shape)
    random = np.random.default_rng(seed)
    images = []
    for axis, periods, steps in fringes:
        size = projector.width if axis == "x" else projector.height
        turns = (periods * (seen[:, 0 if axis == "x" else 1] + 0.5) / size).reshape(shape)
        for step in range(steps):
            level = lit * (0.5 + 0.5 * np.cos(2 * np.pi * (turns - step / steps)))
            fine = light * albedo * level + 0.02
            image = fine.reshape(camera.height, share, camera.width, share).mean(axis=(1, 3)) * 255
            if blur_px:
                image = cv2.GaussianBlur(image, (0, 0), blur_px)
            images.append(np.clip(np.rint(image + random.normal(0, noise, image.shape)), 0, 255).astype(np.uint8))
    return images


def write_folder(
    folder: Path, scanner: Scanner, stacks: dict[str, list[np.ndarray]], board: str | None, fringes=FRINGES
) -> Path:
    """`weldscan-calibration/1`."""
    document = {
        "schema": "weldscan-calibration/1",
        "projector": {"width": scanner.projector.width, "height": scanner.projector.height},
        "fringes": [{"axis": axis, "periods": periods, "steps": steps} for axis, periods, steps in fringes],
    }
    if board is not None:
        document["board"] = board
    for name, images in stacks.items():
        (folder / "shots" / name).mkdir(parents=True)
        for i, image in enumerate(images):
            cv2.imwrite(str(folder / "shots" / name / f"{i:03d}.png"), image)
    (folder / "calibration.json").write_text(json.dumps(document))
    return folder
