//! The four differentiable stages, project to project_backward, over numpy arrays.

use numpy::{Element, PyReadonlyArrayDyn};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};
use splat_render::cpu::Cpu;
use splat_render::reference::Reference;
use splat_render::stages::Float;
use splat_render::{
    Colors, Image, ImageGradients, ProjectOptions, Projected, ProjectedGradients, SplatGradients,
    SplatParams, Stages,
};

use crate::arguments::Call;
use crate::arrays::{array, elements, entry, row, rows, shaped, shaped_rows};
use crate::backend::{Backend, gpu};
use crate::camera::camera;
use crate::error::to_python;

/// A number type that numpy and the stages share: f32 or f64.
pub trait Real: Element + Float + Default + Send + Sync {}
impl Real for f32 {}
impl Real for f64 {}

/// Calls a function that is generic over the number type, with the stages of a backend.
macro_rules! with_stages {
    ($backend:expr, $function:ident($($argument:expr),* $(,)?)) => {
        match Backend::named($backend)? {
            Backend::Cpu => $function::<f32>(&Cpu, $($argument),*),
            Backend::Gpu => $function::<f32>(&*gpu()?, $($argument),*),
            Backend::Reference => $function::<f64>(&Reference, $($argument),*),
        }
    };
}
pub(crate) use with_stages;

/// Names of the parameters, which may be given by position.
pub const PARAMETERS: [&str; 5] = ["means", "quats", "scales", "opacities", "colors"];

/// Arguments of `project` and `project_backward` besides the parameters.
pub struct View {
    /// None: colors are given, not coefficients.
    pub sh_degree: Option<u32>,
    /// Whether scales are logarithms and opacities logits.
    pub raw_parameters: bool,
    pub camera: splat_render::Camera,
    pub options: ProjectOptions,
}

impl View {
    pub fn take(call: &Call<'_>) -> PyResult<Self> {
        Ok(Self {
            sh_degree: call.take("sh_degree")?,
            raw_parameters: call.take("raw_parameters")?,
            camera: camera(
                &call.object("viewmat")?,
                &call.object("intrinsics")?,
                call.take("width")?,
                call.take("height")?,
            )?,
            options: ProjectOptions {
                near: call.take("near")?,
                far: call.take("far")?,
                blur: call.take("eps2d")?,
                antialiased: call.take("antialiased")?,
            },
        })
    }
}

/// Splat parameters as Python gives them. The backend decides the arrays' type.
pub struct Parameters<'py>([Bound<'py, PyAny>; 5]);

impl<'py> Parameters<'py> {
    pub fn take(call: &Call<'py>) -> PyResult<Self> {
        let [means, quats, scales, opacities, colors] = PARAMETERS.map(|name| call.object(name));
        Ok(Self([means?, quats?, scales?, opacities?, colors?]))
    }
}

/// Splat parameters, borrowed from numpy.
pub struct SplatArrays<'py, T: Element> {
    means: PyReadonlyArrayDyn<'py, T>,
    quats: PyReadonlyArrayDyn<'py, T>,
    scales: PyReadonlyArrayDyn<'py, T>,
    opacities: PyReadonlyArrayDyn<'py, T>,
    colors: PyReadonlyArrayDyn<'py, T>,
}

impl<'py, T: Real> SplatArrays<'py, T> {
    pub fn borrow(Parameters(objects): &Parameters<'py>) -> PyResult<Self> {
        let [means, quats, scales, opacities, colors] = objects;
        Ok(Self {
            means: array("means", means)?,
            quats: array("quats", quats)?,
            scales: array("scales", scales)?,
            opacities: array("opacities", opacities)?,
            colors: array("colors", colors)?,
        })
    }

    pub fn params(&self, view: &View) -> PyResult<SplatParams<'_, T>> {
        let means = rows("means", &self.means, &[-1])?;
        let n = means.len() as isize;
        let colors = match view.sh_degree {
            None => Colors::Direct(rows("colors", &self.colors, &[n])?),
            Some(degree) => {
                let coeffs = rows("colors", &self.colors, &[n, -1])?;
                let stride = numpy::PyUntypedArrayMethods::shape(&*self.colors)[1];
                Colors::Sh { degree, stride, coeffs }
            }
        };
        Ok(SplatParams {
            means,
            quats: rows("quats", &self.quats, &[n])?,
            scales: rows("scales", &self.scales, &[n])?,
            opacities: elements("opacities", &self.opacities, &[n])?,
            colors,
            raw: view.raw_parameters,
        })
    }
}

/// Copies 2D splats from the dict that `project` returns.
pub fn projected_from<T: Real>(
    dict: &Bound<'_, PyDict>,
    width: u32,
    height: u32,
) -> PyResult<Projected<T>> {
    fn copied<T: Real, const N: usize>(
        dict: &Bound<'_, PyDict>,
        name: &str,
        n: isize,
    ) -> PyResult<Vec<[T; N]>> {
        Ok(rows(name, &entry::<T>(dict, name)?, &[n])?.to_vec())
    }
    let means2d = copied(dict, "means2d", -1)?;
    let n = means2d.len() as isize;
    let depths = entry(dict, "depths")?;
    let opacities = entry(dict, "opacities")?;
    Ok(Projected {
        width,
        height,
        means2d,
        factors: copied(dict, "factors", n)?,
        depths: elements("depths", &depths, &[n])?.to_vec(),
        colors: copied(dict, "colors", n)?,
        opacities: elements("opacities", &opacities, &[n])?.to_vec(),
        radii: copied(dict, "radii", n)?,
    })
}

/// Projects splats to 2D splats, as one camera sees them.
#[pyfunction]
#[pyo3(
    signature = (*positional, **named),
    text_signature = "(means, quats, scales, opacities, colors, *, sh_degree, raw_parameters, viewmat, intrinsics, width, height, near, far, eps2d, antialiased, backend)"
)]
pub fn project<'py>(
    py: Python<'py>,
    positional: &Bound<'py, PyTuple>,
    named: Option<&Bound<'py, PyDict>>,
) -> PyResult<Bound<'py, PyDict>> {
    let call = Call::bind("project", &PARAMETERS, positional, named)?;
    let (parameters, view) = (Parameters::take(&call)?, View::take(&call)?);
    let backend: String = call.take("backend")?;
    call.finish()?;
    with_stages!(&backend, project_with(py, &parameters, &view))
}

fn project_with<'py, T: Real>(
    stages: &(impl Stages<T> + Sync),
    py: Python<'py>,
    parameters: &Parameters<'py>,
    view: &View,
) -> PyResult<Bound<'py, PyDict>> {
    let arrays = SplatArrays::<T>::borrow(parameters)?;
    let params = arrays.params(view)?;
    let projected =
        py.detach(|| stages.project(&params, &view.camera, &view.options)).map_err(to_python)?;
    let n = [projected.len()];
    let dict = PyDict::new(py);
    dict.set_item("means2d", shaped_rows(py, projected.means2d, &n)?)?;
    dict.set_item("factors", shaped_rows(py, projected.factors, &n)?)?;
    dict.set_item("depths", shaped(py, projected.depths, &n)?)?;
    dict.set_item("colors", shaped_rows(py, projected.colors, &n)?)?;
    dict.set_item("opacities", shaped(py, projected.opacities, &n)?)?;
    dict.set_item("radii", shaped_rows(py, projected.radii, &n)?)?;
    Ok(dict)
}

/// Draws 2D splats over a background.
#[pyfunction]
#[pyo3(signature = (projected, *, width, height, background, backend))]
pub fn rasterize<'py>(
    py: Python<'py>,
    projected: &Bound<'py, PyDict>,
    width: u32,
    height: u32,
    background: &Bound<'py, PyAny>,
    backend: &str,
) -> PyResult<Bound<'py, PyDict>> {
    with_stages!(backend, rasterize_with(py, projected, width, height, background))
}

fn rasterize_with<'py, T: Real>(
    stages: &(impl Stages<T> + Sync),
    py: Python<'py>,
    projected: &Bound<'py, PyDict>,
    width: u32,
    height: u32,
    background: &Bound<'py, PyAny>,
) -> PyResult<Bound<'py, PyDict>> {
    let projected = projected_from::<T>(projected, width, height)?;
    let background = row::<T, 3>("background", background)?;
    let image = py.detach(|| stages.rasterize(&projected, background)).map_err(to_python)?;
    let size = [height as usize, width as usize];
    let dict = PyDict::new(py);
    dict.set_item("color", shaped_rows(py, image.color, &size)?)?;
    dict.set_item("alpha", shaped(py, image.alpha, &size)?)?;
    dict.set_item("depth", shaped(py, image.depth, &size)?)?;
    dict.set_item("transmittance", shaped(py, image.transmittance, &size)?)?;
    Ok(dict)
}

/// Gradients of a picture as Python gives them: `v_color`, `v_alpha`, `v_depth`.
pub struct PictureGradients<'py>([Bound<'py, PyAny>; 3]);

impl<'py> PictureGradients<'py> {
    pub fn take(call: &Call<'py>) -> PyResult<Self> {
        Ok(Self([call.object("v_color")?, call.object("v_alpha")?, call.object("v_depth")?]))
    }

    /// Copies them; they must be of a picture of this size.
    pub fn read<T: Real>(&self, width: u32, height: u32) -> PyResult<ImageGradients<T>> {
        let [v_color, v_alpha, v_depth] = &self.0;
        let size = [height as isize, width as isize];
        Ok(ImageGradients {
            v_color: rows("v_color", &array("v_color", v_color)?, &size)?.to_vec(),
            v_alpha: elements("v_alpha", &array("v_alpha", v_alpha)?, &size)?.to_vec(),
            v_depth: elements("v_depth", &array("v_depth", v_depth)?, &size)?.to_vec(),
        })
    }
}

/// Copies a rendered picture from the dict that `rasterize` returns.
fn image_from<T: Real>(image: &Bound<'_, PyDict>) -> PyResult<Image<T>> {
    let alpha = entry::<T>(image, "alpha")?;
    let &[height, width] = numpy::PyUntypedArrayMethods::shape(&*alpha) else {
        return Err(PyValueError::new_err("alpha: must have shape [H, W]"));
    };
    let side = |side: usize| {
        u32::try_from(side).map_err(|_| PyValueError::new_err("alpha: a side is too long"))
    };
    let size = [height as isize, width as isize];
    let plane = |name: &str| -> PyResult<Vec<T>> {
        Ok(elements(name, &entry(image, name)?, &size)?.to_vec())
    };
    Ok(Image {
        width: side(width)?,
        height: side(height)?,
        color: rows("color", &entry(image, "color")?, &size)?.to_vec(),
        alpha: plane("alpha")?,
        depth: plane("depth")?,
        transmittance: plane("transmittance")?,
    })
}

/// Arguments of `rasterize_backward`.
struct RasterizeBackward<'py> {
    projected: Bound<'py, PyDict>,
    image: Bound<'py, PyDict>,
    v_image: PictureGradients<'py>,
    background: Bound<'py, PyAny>,
    /// Whether to add up absolute gradients of the means, too.
    absolute: bool,
}

/// Turns gradients of a picture into gradients of its 2D splats and background.
#[pyfunction]
#[pyo3(
    signature = (*positional, **named),
    text_signature = "(projected, image, *, v_color, v_alpha, v_depth, background, absolute, backend)"
)]
pub fn rasterize_backward<'py>(
    py: Python<'py>,
    positional: &Bound<'py, PyTuple>,
    named: Option<&Bound<'py, PyDict>>,
) -> PyResult<Bound<'py, PyDict>> {
    let call = Call::bind("rasterize_backward", &["projected", "image"], positional, named)?;
    let arguments = RasterizeBackward {
        projected: call.dict("projected")?,
        image: call.dict("image")?,
        v_image: PictureGradients::take(&call)?,
        background: call.object("background")?,
        absolute: call.take("absolute")?,
    };
    let backend: String = call.take("backend")?;
    call.finish()?;
    with_stages!(&backend, rasterize_backward_with(py, &arguments))
}

fn rasterize_backward_with<'py, T: Real>(
    stages: &(impl Stages<T> + Sync),
    py: Python<'py>,
    arguments: &RasterizeBackward<'py>,
) -> PyResult<Bound<'py, PyDict>> {
    let image = image_from::<T>(&arguments.image)?;
    let (width, height) = (image.width, image.height);
    let projected = projected_from::<T>(&arguments.projected, width, height)?;
    let background = row::<T, 3>("background", &arguments.background)?;
    let v_image = arguments.v_image.read(width, height)?;
    let absolute = arguments.absolute;
    let v: ProjectedGradients<T> = py
        .detach(|| stages.rasterize_backward(&projected, background, &image, &v_image, absolute))
        .map_err(to_python)?;
    let n = [projected.len()];
    let dict = PyDict::new(py);
    dict.set_item("v_means2d", shaped_rows(py, v.v_means2d, &n)?)?;
    dict.set_item("v_factors", shaped_rows(py, v.v_factors, &n)?)?;
    if let Some(v_absolute) = v.v_means2d_absolute {
        dict.set_item("v_means2d_absolute", shaped_rows(py, v_absolute, &n)?)?;
    }
    dict.set_item("v_depths", shaped(py, v.v_depths, &n)?)?;
    dict.set_item("v_colors", shaped_rows(py, v.v_colors, &n)?)?;
    dict.set_item("v_opacities", shaped(py, v.v_opacities, &n)?)?;
    dict.set_item("v_background", shaped(py, v.v_background.to_vec(), &[3])?)?;
    Ok(dict)
}

/// Turns gradients of 2D splats into gradients of the splats and the camera.
#[pyfunction]
#[pyo3(
    signature = (*positional, **named),
    text_signature = "(means, quats, scales, opacities, colors, projected, v_projected, *, sh_degree, raw_parameters, viewmat, intrinsics, width, height, near, far, eps2d, antialiased, backend)"
)]
pub fn project_backward<'py>(
    py: Python<'py>,
    positional: &Bound<'py, PyTuple>,
    named: Option<&Bound<'py, PyDict>>,
) -> PyResult<Bound<'py, PyDict>> {
    let names = [&PARAMETERS[..], &["projected", "v_projected"]].concat();
    let call = Call::bind("project_backward", &names, positional, named)?;
    let (parameters, view) = (Parameters::take(&call)?, View::take(&call)?);
    let (projected, v_projected) = (call.dict("projected")?, call.dict("v_projected")?);
    let backend: String = call.take("backend")?;
    call.finish()?;
    with_stages!(&backend, project_backward_with(py, &parameters, &view, &projected, &v_projected))
}

fn project_backward_with<'py, T: Real>(
    stages: &(impl Stages<T> + Sync),
    py: Python<'py>,
    parameters: &Parameters<'py>,
    view: &View,
    projected: &Bound<'py, PyDict>,
    v_projected: &Bound<'py, PyDict>,
) -> PyResult<Bound<'py, PyDict>> {
    let arrays = SplatArrays::<T>::borrow(parameters)?;
    let params = arrays.params(view)?;
    let (camera, options) = (&view.camera, &view.options);
    let projected = projected_from::<T>(projected, camera.width, camera.height)?;
    let n = params.len() as isize;
    let v = v_projected;
    let v_projected = ProjectedGradients {
        v_means2d: rows("v_means2d", &entry(v, "v_means2d")?, &[n])?.to_vec(),
        v_factors: rows("v_factors", &entry(v, "v_factors")?, &[n])?.to_vec(),
        v_depths: elements("v_depths", &entry(v, "v_depths")?, &[n])?.to_vec(),
        v_colors: rows("v_colors", &entry(v, "v_colors")?, &[n])?.to_vec(),
        v_opacities: elements("v_opacities", &entry(v, "v_opacities")?, &[n])?.to_vec(),
        v_background: [T::default(); 3],
        v_means2d_absolute: None,
    };
    if projected.len() != params.len() {
        return Err(PyValueError::new_err(format!(
            "projected: has {} splats, but means has {}",
            projected.len(),
            params.len()
        )));
    }
    let gradients: SplatGradients<T> = py
        .detach(|| stages.project_backward(&params, camera, options, &projected, &v_projected))
        .map_err(to_python)?;
    let n = params.len();
    let color_shape = match params.colors {
        Colors::Direct(_) => vec![n],
        Colors::Sh { stride, .. } => vec![n, stride],
    };
    // The last row of a rigid matrix is fixed.
    let mut v_viewmat: Vec<f64> = gradients.v_viewmat.concat();
    v_viewmat.extend([0.0; 4]);
    let dict = PyDict::new(py);
    dict.set_item("v_means", shaped_rows(py, gradients.v_means, &[n])?)?;
    dict.set_item("v_quats", shaped_rows(py, gradients.v_quats, &[n])?)?;
    dict.set_item("v_scales", shaped_rows(py, gradients.v_scales, &[n])?)?;
    dict.set_item("v_opacities", shaped(py, gradients.v_opacities, &[n])?)?;
    dict.set_item("v_colors", shaped_rows(py, gradients.v_colors, &color_shape)?)?;
    dict.set_item("v_viewmat", shaped(py, v_viewmat, &[4, 4])?)?;
    dict.set_item("v_intrinsics", shaped(py, gradients.v_intrinsics.to_vec(), &[4])?)?;
    Ok(dict)
}
