"""Point clouds: nearest neighbours, normals, registration, distances to meshes and surfaces."""

from weldscan._weldcore import (
    Cloud,
    Follower,
    KdTree,
    Mesh,
    Registration,
    RigidFit,
    WeakDirection,
    distance,
    estimate_normals,
    register_icp,
    register_rigid,
)

__all__ = [
    "Cloud",
    "Follower",
    "KdTree",
    "Mesh",
    "Registration",
    "RigidFit",
    "WeakDirection",
    "distance",
    "estimate_normals",
    "register_icp",
    "register_rigid",
]
