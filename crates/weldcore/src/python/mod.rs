//! The binding, and the only home of pyo3 and numpy. Each wrapper does four things and no arithmetic: it checks shape
//! and order, detaches from the interpreter and calls the core, maps the error, hands the result over without a copy.
//!
//! A room of the core has one of the same name here with a `register` function; [`call`] and [`convert`] are what all of
//! them need.

mod call;
mod clouds;
mod convert;
mod fringes;
mod ground;
mod pickle;
mod scanner;
mod seam;
mod simulate;
mod step;
mod surfaces;
mod weld;

use pyo3::prelude::*;

use crate::ground::allocator::Recycler;

#[global_allocator]
static ALLOCATOR: Recycler = Recycler;

#[pymodule]
#[pyo3(name = "_weldcore")]
fn weldcore(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add("__version__", env!("CARGO_PKG_VERSION"))?;
    ground::register(m)?;
    fringes::register(m)?;
    surfaces::register(m)?;
    scanner::register(m)?;
    clouds::register(m)?;
    seam::register(m)?;
    weld::register(m)?;
    step::register(m)?;
    simulate::register(m)?;
    pickle::register(m)
}
