//! Splat parameters, and arrays of their shapes, as dicts of numpy arrays.

use numpy::PyUntypedArrayMethods;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use splat_render::fit::SplatArrays;

use crate::arrays::{elements, entry, rows, shaped, shaped_rows};

/// Reads splat parameters, or moments of the optimizer under a prefix.
pub fn splat_arrays_from(dict: &Bound<'_, PyDict>, prefix: &str) -> PyResult<SplatArrays> {
    fn copied<const N: usize>(
        dict: &Bound<'_, PyDict>,
        name: &str,
        leading: &[isize],
    ) -> PyResult<Vec<[f32; N]>> {
        Ok(rows(name, &entry::<f32>(dict, name)?, leading)?.to_vec())
    }
    let means = copied(dict, &format!("{prefix}means"), &[-1])?;
    let n = means.len() as isize;
    let sh_name = format!("{prefix}sh");
    let sh = entry::<f32>(dict, &sh_name)?;
    let coeffs = rows::<f32, 3>(&sh_name, &sh, &[n, -1])?.to_vec();
    let stride = sh.shape()[1];
    let Some(sh_degree) = (0..=splat_render::constants::SH_DEGREE_MAX)
        .find(|&degree| splat_render::sh::coeffs(degree) == stride)
    else {
        return Err(PyValueError::new_err(format!(
            "{sh_name}: must have 1, 4, 9, 16 or 25 coefficients, not {stride}"
        )));
    };
    let opacities_name = format!("{prefix}opacities");
    let opacities = entry::<f32>(dict, &opacities_name)?;
    Ok(SplatArrays {
        means,
        quats: copied(dict, &format!("{prefix}quats"), &[n])?,
        scales: copied(dict, &format!("{prefix}scales"), &[n])?,
        opacities: elements(&opacities_name, &opacities, &[n])?.to_vec(),
        sh: coeffs,
        sh_degree,
    })
}

/// Writes the entries that [`splat_arrays_from`] reads.
pub fn set_splat_arrays(
    dict: &Bound<'_, PyDict>,
    prefix: &str,
    splats: SplatArrays,
) -> PyResult<()> {
    let py = dict.py();
    let (n, stride) = (splats.len(), splats.stride());
    dict.set_item(format!("{prefix}means"), shaped_rows(py, splats.means, &[n])?)?;
    dict.set_item(format!("{prefix}quats"), shaped_rows(py, splats.quats, &[n])?)?;
    dict.set_item(format!("{prefix}scales"), shaped_rows(py, splats.scales, &[n])?)?;
    dict.set_item(format!("{prefix}opacities"), shaped(py, splats.opacities, &[n])?)?;
    dict.set_item(format!("{prefix}sh"), shaped_rows(py, splats.sh, &[n, stride])?)
}
