//! Renders as OpenEXR files in 32-bit float.

use exr::prelude::{
    AnyChannel, AnyChannels, Encoding, FlatSamples, Image, Layer, LayerAttributes, SmallVec,
    WritableImage,
};
use pyo3::exceptions::{PyOSError, PyValueError};
use pyo3::prelude::*;

use crate::arrays::{array, elements, rows};

/// Writes color [H, W, 3], alpha [H, W] and depth [H, W] as channels R, G, B, A, Z.
#[pyfunction]
pub fn write_exr(
    py: Python<'_>,
    path: &str,
    color: &Bound<'_, PyAny>,
    alpha: &Bound<'_, PyAny>,
    depth: &Bound<'_, PyAny>,
) -> PyResult<()> {
    let alpha = array::<f32>("alpha", alpha)?;
    let &[height, width] = numpy::PyUntypedArrayMethods::shape(&*alpha) else {
        return Err(PyValueError::new_err("alpha: must have shape [H, W]"));
    };
    if width == 0 || height == 0 {
        return Err(PyValueError::new_err("alpha: must have at least one pixel"));
    }
    let size = [height as isize, width as isize];
    let color = array::<f32>("color", color)?;
    let color = rows::<f32, 3>("color", &color, &size)?;
    let depth = array::<f32>("depth", depth)?;
    let depth = elements("depth", &depth, &size)?;
    let alpha = elements("alpha", &alpha, &size)?;
    let channel = |name: &str, samples: Vec<f32>| AnyChannel::new(name, FlatSamples::F32(samples));
    let plane = |i: usize| color.iter().map(|rgb| rgb[i]).collect::<Vec<f32>>();
    let channels: SmallVec<[_; 4]> = [
        channel("R", plane(0)),
        channel("G", plane(1)),
        channel("B", plane(2)),
        channel("A", alpha.to_vec()),
        channel("Z", depth.to_vec()),
    ]
    .into_iter()
    .collect();
    let layer = Layer::new(
        (width, height),
        LayerAttributes::default(),
        Encoding::SMALL_LOSSLESS,
        AnyChannels::sort(channels),
    );
    py.detach(|| Image::from_layer(layer).write().to_file(path))
        .map_err(|error| PyOSError::new_err(error.to_string()))
}
