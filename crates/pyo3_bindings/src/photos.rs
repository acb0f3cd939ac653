//! The photos of a fit, from numpy arrays.

use numpy::PyUntypedArrayMethods;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyList;
use splat_render::fit::{Target, TargetDepth};

use crate::arguments::Call;
use crate::arrays::{array, elements};
use crate::error::to_python;

/// Weights of a photo's pixels, [H, W], from a mask (bool) or from weights (float32).
fn weights_from(name: &str, mask: &Bound<'_, PyAny>, size: [usize; 2]) -> PyResult<Vec<f32>> {
    let size = size.map(|side| side as isize);
    if let Ok(weights) = array::<f32>(name, mask) {
        return Ok(elements(name, &weights, &size)?.to_vec());
    }
    array::<bool>(name, mask)?;
    // numpy lets a bool hold any byte; Rust's bool may only be read as 0 or 1.
    let bytes = mask.call_method1("view", (numpy::dtype::<u8>(mask.py()),))?;
    let bytes = array::<u8>(name, &bytes)?;
    let bytes = elements(name, &bytes, &size)?;
    Ok(bytes.iter().map(|&counts| if counts == 0 { 0.0 } else { 1.0 }).collect())
}

/// Depths of `count` photos; an entry of `depths` is None, or z and confidence `[H, W, 2]`.
fn depths_from(call: &Call<'_>, count: usize) -> PyResult<Vec<Option<TargetDepth>>> {
    let Some(depths) = call.optional::<Bound<'_, PyList>>("depths")? else {
        return Ok(vec![None; count]);
    };
    if depths.len() != count {
        return Err(PyValueError::new_err(format!(
            "depths: has {} entries for {count} images",
            depths.len()
        )));
    }
    let depth = |(i, depth): (usize, Bound<'_, PyAny>)| {
        if depth.is_none() {
            return Ok(None);
        }
        let name = format!("depths[{i}]");
        let depth = array::<f32>(&name, &depth)?;
        let values = elements(&name, &depth, &[-1, -1, 2])?;
        Ok(Some(TargetDepth {
            depths: values.iter().step_by(2).copied().collect(),
            confidences: values.iter().skip(1).step_by(2).copied().collect(),
        }))
    };
    depths.iter().enumerate().map(depth).collect()
}

/// The photos: `images`, `masks`, `backgrounds`, `schedule` and, if given, `depths`.
pub fn targets_from(call: &Call<'_>) -> PyResult<Vec<Target>> {
    let (images, masks) =
        (call.take::<Bound<'_, PyList>>("images")?, call.take::<Bound<'_, PyList>>("masks")?);
    let backgrounds: Vec<Option<[f32; 3]>> = call.take("backgrounds")?;
    let schedule: Vec<(u32, Option<u32>)> = call.take("schedule")?;
    for (name, entries) in
        [("masks", masks.len()), ("backgrounds", backgrounds.len()), ("schedule", schedule.len())]
    {
        if images.len() != entries {
            return Err(PyValueError::new_err(format!(
                "{name}: has {entries} entries for {} images",
                images.len()
            )));
        }
    }
    let depths = depths_from(call, images.len())?;
    let mut targets = Vec::with_capacity(images.len());
    for (i, ((image, mask), depth)) in images.iter().zip(masks.iter()).zip(depths).enumerate() {
        let name = format!("images[{i}]");
        let image = array::<u8>(&name, &image)?;
        let pixels = elements(&name, &image, &[-1, -1, -1])?;
        let &[height, width, channels] = image.shape() else {
            return Err(PyValueError::new_err(format!("{name}: must have shape [H, W, C]")));
        };
        let weights = if mask.is_none() {
            None
        } else {
            Some(weights_from(&format!("masks[{i}]"), &mask, [height, width])?)
        };
        let size = |size: usize| {
            u32::try_from(size).map_err(|_| PyValueError::new_err(format!("{name}: is too large")))
        };
        let target = Target {
            width: size(width)?,
            height: size(height)?,
            channels: size(channels)?,
            pixels: pixels.to_vec(),
            weights,
            depth,
            background: backgrounds[i],
            turns: schedule[i].0,
            until: schedule[i].1,
        };
        target.validate(i).map_err(to_python)?;
        targets.push(target);
    }
    Ok(targets)
}
