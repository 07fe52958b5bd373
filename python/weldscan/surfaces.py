"""Plane, sphere and cylinder: fitted with their covariance, and spheres found in a cloud."""

from weldscan._weldcore import (
    Cylinder,
    CylinderFit,
    FoundSphere,
    Plane,
    PlaneFit,
    Sphere,
    SphereFit,
    find_spheres,
    fit_cylinder,
    fit_plane,
    fit_sphere,
    sphere_through_points,
)

__all__ = [
    "Cylinder",
    "CylinderFit",
    "FoundSphere",
    "Plane",
    "PlaneFit",
    "Sphere",
    "SphereFit",
    "find_spheres",
    "fit_cylinder",
    "fit_plane",
    "fit_sphere",
    "sphere_through_points",
]
