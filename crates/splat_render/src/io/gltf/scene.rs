//! Transforms of a glTF scene's meshes by its nodes.

use glam::{DMat3, DMat4, DQuat, DVec3};
use serde_json::Value;

use super::document::{Document, number};
use crate::error::Result;

/// Relative tolerance of a node's axes in length and angle; float32 matrices are within it.
const SHAPE_TOLERANCE: f64 = 1e-4;

pub struct Placed {
    pub mesh: usize,
    pub rotation: Option<DQuat>,
    pub scale: f64,
    pub translation: DVec3,
}

/// Every mesh of the scene that the file shows first, in the order of its nodes.
pub fn placed_meshes(document: &Document<'_>) -> Result<Vec<Placed>> {
    let scene = number(&document.json, "scene").unwrap_or(0);
    let roots = match document.list("scenes").get(scene) {
        Some(scene) => indices(scene, "nodes"),
        // Without scenes, all root nodes are shown.
        None => {
            let nodes = document.list("nodes");
            let children: std::collections::HashSet<usize> =
                nodes.iter().flat_map(|node| indices(node, "children")).collect();
            (0..nodes.len()).filter(|k| !children.contains(k)).collect()
        }
    };
    let mut seen = vec![false; document.list("nodes").len()];
    let mut found = Vec::new();
    let mut open: Vec<(usize, DMat4)> =
        roots.into_iter().rev().map(|root| (root, DMat4::IDENTITY)).collect();
    while let Some((index, parent)) = open.pop() {
        let node = document.item("nodes", index)?;
        if std::mem::replace(&mut seen[index], true) {
            return Err(
                document.bad(format!("shows nodes[{index}] twice, which glTF does not allow"))
            );
        }
        let matrix = parent * local_matrix(node);
        if let Some(mesh) = number(node, "mesh") {
            found.push(place(document, index, mesh, matrix)?);
        }
        open.extend(indices(node, "children").into_iter().rev().map(|child| (child, matrix)));
    }
    Ok(found)
}

fn indices(object: &Value, key: &str) -> Vec<usize> {
    let list = object.get(key).and_then(Value::as_array).map_or(&[] as &[Value], Vec::as_slice);
    list.iter().filter_map(|v| usize::try_from(v.as_u64()?).ok()).collect()
}

fn numbers<const N: usize>(node: &Value, key: &str) -> Option<[f64; N]> {
    let values: Option<Vec<f64>> = node.get(key)?.as_array()?.iter().map(Value::as_f64).collect();
    values?.try_into().ok()
}

fn local_matrix(node: &Value) -> DMat4 {
    if let Some(matrix) = numbers::<16>(node, "matrix") {
        return DMat4::from_cols_array(&matrix);
    }
    let translation = numbers(node, "translation").map_or(DVec3::ZERO, DVec3::from_array);
    let rotation = numbers(node, "rotation").map_or(DQuat::IDENTITY, DQuat::from_array);
    let scale = numbers(node, "scale").map_or(DVec3::ONE, DVec3::from_array);
    DMat4::from_translation(translation)
        * DMat4::from_mat3(DMat3::from_quat(rotation) * DMat3::from_diagonal(scale))
}

/// A node's matrix as turn, uniform scale and shift; splats cannot be sheared or mirrored.
fn place(document: &Document<'_>, node: usize, mesh: usize, matrix: DMat4) -> Result<Placed> {
    let bad = || {
        document.bad(format!(
            "has nodes[{node}] that shears, mirrors or unevenly scales its splats; apply its \
             transform in the program that wrote it"
        ))
    };
    let axes = DMat3::from_mat4(matrix);
    let scale = axes.determinant().cbrt();
    let grid = axes.transpose() * axes * (1.0 / (scale * scale));
    let off = (grid - DMat3::IDENTITY)
        .to_cols_array()
        .into_iter()
        .fold(0.0, |off: f64, c| if c.is_nan() { f64::INFINITY } else { off.max(c.abs()) });
    let translation = matrix.w_axis.truncate();
    if scale.is_nan() || scale <= 0.0 || off > SHAPE_TOLERANCE || !translation.is_finite() {
        return Err(bad());
    }
    let rotation = (axes != DMat3::from_diagonal(DVec3::splat(scale)))
        .then(|| DQuat::from_mat3(&(axes * (1.0 / scale))).normalize());
    Ok(Placed { mesh, rotation, scale, translation })
}
