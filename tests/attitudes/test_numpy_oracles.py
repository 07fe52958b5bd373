"""What touches every point or pixel, in the core, against the same in NumPy: plainer, slower, by its formula."""

from __future__ import annotations

import math

import numpy as np
import pytest

import weldscan as ws
from weldscan._weldcore import capture_quality, quadric_distances, saturation_level, sphere_caps
from weldscan.errors import InputError
from weldscan.simulated import DEFAULT

# Sums in another order, of numbers of some hundred mm.
SAME_MM = 1e-10


# --- the pixels that look at spheres


def first_hit(ray, centre, radius):
    along = ray @ centre
    square = along**2 - float(centre @ centre) + radius**2
    with np.errstate(invalid="ignore"):
        return np.where(square > 0, along - np.sqrt(np.maximum(square, 0)), np.inf)


def caps_in_numpy(lens, centres, radius):
    """Over the whole image, so of spheres whose caps are inside of it: pixels and unit vectors of each."""
    row, column = (g.ravel() for g in np.mgrid[: lens.height, : lens.width])
    ray = np.column_stack([lens.undistort(np.column_stack([column, row]).astype(float)), np.ones(column.size)])
    ray /= np.linalg.norm(ray, axis=1)[:, None]
    depth = np.array([first_hit(ray, centre, radius) for centre in centres])
    for i, centre in enumerate(centres):
        with np.errstate(invalid="ignore"):
            outward = (depth[i][:, None] * ray - centre) / radius
            cap = np.isfinite(depth[i]) & (outward @ (-centre / np.linalg.norm(centre)) >= 0.5)
        seen = cap & np.all(np.delete(depth, i, axis=0) > depth[i], axis=0)
        yield np.flatnonzero(seen), outward[seen], int(cap.sum())


def test_caps_are_those_of_every_pixels_ray():
    lens = DEFAULT.scanner.camera
    centres = np.array([[5.0, -10, 400], [20.0, 0, 450], [-40.0, 20, 380]])
    found, expected = sphere_caps(lens, centres, 10.0), list(caps_in_numpy(lens, centres, 10.0))
    assert len(expected[1][0]) < expected[1][2]  # one is hidden in part
    for (pixels, outward, whole), (all_pixels, all_outward, all_whole) in zip(found, expected, strict=True):
        assert np.array_equal(pixels, all_pixels) and whole == all_whole > 1000
        np.testing.assert_allclose(outward, all_outward, atol=SAME_MM)
    with pytest.raises(InputError, match="radius_mm"):
        sphere_caps(lens, centres, -1.0)
    with pytest.raises(InputError, match="not finite"):
        sphere_caps(lens, centres * np.nan, 1.0)


# --- points held against a cloud


def held_in_numpy(point, patch, radius):
    """Distance to the quadric through a patch, its standard uncertainty, normal; None: it would be extrapolated."""
    if len(patch) < 30:
        return None
    aside, along, normal = np.linalg.svd(patch - patch.mean(axis=0), full_matrices=False)[2]
    offset = patch - point
    u, v, w = offset @ aside, offset @ along, offset @ normal
    if math.hypot(u.mean(), v.mean()) > 0.3 * radius:
        return None
    terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)
    keep = np.ones(len(w), bool)
    for _ in range(2):
        solution = np.linalg.lstsq(terms[keep], w[keep], rcond=None)[0]
        residual = w - terms @ solution
        sigma = float(np.sqrt(np.square(residual[keep]).sum() / (keep.sum() - 6)))
        keep = np.abs(residual) <= 3 * max(sigma, 1e-9)
        if keep.sum() < 30:
            return None
    height, slope_u, slope_v = solution[:3]
    if abs(height) > radius:
        return None
    variance = sigma**2 * np.linalg.inv(terms[keep].T @ terms[keep])[0, 0]
    return -height / math.sqrt(1 + slope_u**2 + slope_v**2), math.sqrt(4 * variance), normal


def test_points_are_held_against_the_quadrics_of_numpy():
    random, radius = np.random.default_rng(4), 1.5
    angle, z = random.uniform(-0.3, 0.3, 60_000), random.uniform(-20, 20, 60_000)
    r = 80 + 0.02 * np.sin(z) + random.normal(0, 0.01, len(z)) + 0.3 * (random.random(len(z)) < 0.01)
    cloud = np.column_stack([r * np.cos(angle), r * np.sin(angle), z])
    cloud = cloud[~((np.abs(z) < 1) & (angle > 0))]
    at, along = random.uniform(-0.35, 0.35, 300), random.uniform(-21, 21, 300)
    off = 80 + random.uniform(-1.8, 1.8, 300)
    points = np.column_stack([off * np.cos(at), off * np.sin(at), along])
    _, near = ws.KdTree(cloud).radius(points, radius)
    distance, standard, normal = quadric_distances(cloud, points, near, radius)
    expected = [held_in_numpy(p, cloud[patch], radius) for p, patch in zip(points, near, strict=True)]
    held = np.array([each is not None for each in expected])
    assert 100 < held.sum() < 290 and np.array_equal(np.isfinite(distance), held)
    for i in np.flatnonzero(held):
        d, u, n = expected[i]
        side = np.sign(normal[i] @ n)
        np.testing.assert_allclose([side * distance[i], standard[i]], [d, u], atol=SAME_MM)
        np.testing.assert_allclose(side * normal[i], n, atol=1e-8)  # rotations of a nearly round patch
    with pytest.raises(InputError, match="below the"):
        quadric_distances(cloud[:5], points[:1], [np.array([7], np.uint32)], radius)


# --- the quality of captures


def quality_in_numpy(stacks, first, steps, least):
    best, unsaturated = np.zeros(stacks[0][0].shape), np.zeros(stacks[0][0].shape, bool)
    turn = np.exp(2j * np.pi * np.arange(steps) / steps)
    for stack in stacks:
        level, top, _ = saturation_level(stack)
        whole = np.maximum.reduce(stack) < level
        modulation = np.abs(np.tensordot(turn, np.asarray(stack[first : first + steps], float), 1)) * 2 / steps / top
        best = np.where(whole, np.maximum(best, modulation), best)
        unsaturated |= whole
    usable = unsaturated & (best >= least)
    return usable.mean(), (~unsaturated).mean(), (unsaturated & ~usable).mean(), np.median(best[usable])


@pytest.mark.parametrize(("kind", "top"), [(np.uint8, 255), (np.uint16, 4095)])
def test_the_quality_of_captures_is_that_of_every_pixel(kind, top):
    random, shape = np.random.default_rng(6), (150, 211)
    phase = np.linspace(0, 60, shape[1]) + np.zeros(shape)
    light, contrast = np.linspace(0.02, 4.0, shape[0])[:, None], random.random(shape)
    stacks = []
    for exposure in (0.4, 1.0):
        wave = [
            light * exposure * (1 + contrast * np.cos(phase * f - 2 * np.pi * k / 5)) / 2
            for f in (0.1, 1)
            for k in range(5)
        ]
        noisy = [np.clip(top * each + random.normal(0, 1, shape), 0, top) for each in wave]
        stacks.append([each.astype(kind) for each in noisy])
    found, expected = capture_quality(stacks, 5, 5, 0.05), quality_in_numpy(stacks, 5, 5, 0.05)
    # In single precision a pixel in ten thousand may stand on the other side of the least modulation.
    np.testing.assert_allclose(found, expected, atol=1e-4)
    assert min(found) > 0.02 and abs(sum(found[:3]) - 1) < 1e-12
    with pytest.raises(InputError, match="exposures"):
        capture_quality(stacks, 8, 5, 0.05)
    with pytest.raises(InputError, match="another type"):
        capture_quality([stacks[0], [each.astype(float) for each in stacks[1]]], 5, 5, 0.05)


# --- a sphere from one near by


def test_a_sphere_is_fitted_from_one_near_by_where_strays_lead_astray():
    random = np.random.default_rng(8)
    cap = random.normal(size=(4000, 3))
    cap = cap[cap[:, 2] < -0.6 * np.linalg.norm(cap, axis=1)]
    points = np.array([5.0, 3.0, 400.0]) + 10.01 * cap / np.linalg.norm(cap, axis=1)[:, None]
    points += random.normal(0, 0.01, points.shape)
    plain = ws.fit_sphere(points)
    for near in (ws.Sphere([6, 3, 401], 9.0), ws.fit_sphere(points, 10.0), ws.find_spheres(points, 10.0)[0]):
        found = ws.fit_sphere(points, near=near)
        np.testing.assert_allclose([*found.center_mm, found.radius_mm], [*plain.center_mm, plain.radius_mm], atol=1e-8)
    fixed = ws.fit_sphere(points, 10.0, near=ws.Sphere([6, 3, 401], 3.0))
    assert fixed.radius_mm == 10.0
    np.testing.assert_allclose(fixed.center_mm, ws.fit_sphere(points, 10.0).center_mm, atol=1e-8)
    for near, robust in ((ws.Plane([0, 0, 0], [0, 0, 1]), False), (ws.Sphere([6, 3, 401], 9.0), True), (7, False)):
        with pytest.raises(InputError, match="near"):
            ws.fit_sphere(points, near=near, robust=robust)
