//! Universal kriging of two walls to the seam: what each wall's unevenness is like, what both say of the terms they share, and how
//! far they stand apart, with one covariance for all places.
//!
//! # Model
//! A cell's height on a wall is `X b + f(along, across) + e`. The unevenness f is a Gaussian process, a wall's own, the same
//! for all shots that see it: [`chain`] along the seam times [`basis`] across. e is the noise of the cell's mean. b are the
//! unknowns of the border, each with a proper Gaussian prior: Fourier terms, shell terms, what each shot is displaced by, and
//! whatever else a caller has columns for. [`sweep`] takes the unevenness out, [`border`] joins the walls, [`likelihood`] finds
//! what the unevenness is like, [`draws`] say how large the largest of many places is.
//!
//! Source: N. Cressie, Statistics for Spatial Data (1993), 3.4.

mod basis;
mod border;
mod chain;
mod draws;
mod likelihood;
mod rows;
mod stretch;
mod sweep;
#[cfg(test)]
mod tests;
mod wall;

pub(crate) use border::{Answer, Border, BorderColumns};
pub(crate) use draws::{Largest, largest};
pub(crate) use likelihood::{Prior, fit, fit_near};
pub(crate) use stretch::Stretch;
pub(crate) use sweep::{Reduced, sweep};
pub(crate) use wall::{Asked, Cell, KrigedWall, Scales, SeamLine, Width};
