//! Clouds of points and meshes: neighbours, normals, distances, registration.

pub mod distance;
pub mod icp;
pub mod kdtree;
pub mod mesh;
pub mod normals;
pub mod quadric;
