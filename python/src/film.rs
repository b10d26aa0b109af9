//! Pictures of environments, for people.

use comic_tasks::Ghost;
use comic_tasks::film::{Camera, Shot, Size};
use numpy::{IntoPyArray as _, PyArray3, PyArrayMethods as _};
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;

use crate::environments::Environments;
use crate::refuse;

/// Draws pictures. An OpenGL context belongs to the thread that made it, so only this thread may draw.
#[pyclass(unsendable, module = "comic._native")]
#[derive(Debug)]
pub(crate) struct Film {
    film: comic_tasks::film::Film,
    size: Size,
}

#[pymethods]
impl Film {
    /// `camera` is tracking, egocentric or side; `ghost` is on, beside or `None`.
    #[new]
    fn new(width: u16, height: u16, camera: &str, ghost: Option<&str>) -> PyResult<Self> {
        let size = Size::new(width, height)
            .ok_or_else(|| refuse(format!("render_size: {width} × {height}; both must be from 16 to 2048")))?;
        let camera = match camera {
            "tracking" => Camera::Tracking,
            "egocentric" => Camera::Egocentric,
            "side" => Camera::Side,
            other => return Err(refuse(format!("no camera `{other}`; cameras are tracking, egocentric and side"))),
        };
        let ghost = ghost.map(str::parse::<Ghost>).transpose().map_err(refuse)?;
        Ok(Self { film: comic_tasks::film::Film::new(Shot { size, camera, ghost }), size })
    }

    /// A picture of environment `index`: `[height, width, 3]`.
    fn draw<'py>(
        &mut self,
        python: Python<'py>,
        environments: &Environments,
        index: usize,
    ) -> PyResult<Bound<'py, PyArray3<u8>>> {
        let picture = environments.with(index, |environment| {
            let drawn = self.film.draw(environment).map(<[u8]>::to_vec);
            drawn.map_err(|error| PyRuntimeError::new_err(error.to_string()))
        })?;
        picture.into_pyarray(python).reshape([self.size.height().into(), self.size.width().into(), 3])
    }
}
