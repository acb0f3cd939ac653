//! Rigs: cameras that share one center and move as one, as the views of a panorama do.
//!
//! All members take the step of the whole, each in its own axes: gradients, measures and priors are
//! brought to the axes of the rig's first camera, added up, and turned back.

use glam::{DMat3, DVec3};

use super::motion::{POSE, PoseMatrix};
use crate::camera::Camera;
use crate::error::{Error, Result};

/// Largest distance between a rig's centers, relative to their distances to origin and scene.
const ONE_CENTER: f64 = 1e-5;

#[derive(Debug, Clone)]
pub(super) struct Rigs {
    /// The first camera of each camera's rig.
    first: Vec<usize>,
    /// From the axes of that one to the camera's own.
    turn: Vec<DMat3>,
}

impl Rigs {
    /// Every camera is a rig alone.
    pub(super) fn none(count: usize) -> Self {
        Self { first: (0..count).collect(), turn: vec![DMat3::IDENTITY; count] }
    }

    /// Cameras with one number are a rig.
    pub(super) fn new(cameras: &[Camera], numbers: &[u32], distances: &[f64]) -> Result<Self> {
        let refused = |why: String| Err(Error::argument("rigs", why));
        if numbers.len() != cameras.len() {
            return refused(format!("must have one number for each of {} cameras", cameras.len()));
        }
        let mut rigs = Self::none(cameras.len());
        for (k, number) in numbers.iter().enumerate() {
            let first = numbers.iter().position(|other| other == number).unwrap_or(k);
            let (from, to) = (&cameras[first], &cameras[k]);
            let apart = from.center().distance(to.center());
            if apart > ONE_CENTER * (distances[k] + from.center().length()) {
                return refused(format!("cameras {first} and {k} do not share a center"));
            }
            rigs.first[k] = first;
            rigs.turn[k] = to.rotation() * from.rotation().transpose();
        }
        Ok(rigs)
    }

    pub(super) fn any(&self) -> bool {
        self.first.iter().enumerate().any(|(k, &first)| first != k)
    }

    /// The members of each rig, whose first is the key.
    fn members(&self, first: usize) -> impl Iterator<Item = usize> + '_ {
        (0..self.first.len()).filter(move |&k| self.first[k] == first)
    }

    fn firsts(&self) -> impl Iterator<Item = usize> + '_ {
        (0..self.first.len()).filter(|&k| self.first[k] == k)
    }

    /// Gives each camera the sum of its rig's pose gradients, in its own axes.
    pub(super) fn share_gradients(&self, gradients: &mut [[f64; POSE + 1]]) {
        for first in self.firsts() {
            let mut sum = [DVec3::ZERO; 2];
            for k in self.members(first) {
                for (part, sum) in sum.iter_mut().enumerate() {
                    *sum += self.turn[k].transpose() * part_of(&gradients[k], part);
                }
            }
            for k in self.members(first) {
                for (part, sum) in sum.iter().enumerate() {
                    let turned = self.turn[k] * *sum;
                    gradients[k][3 * part..3 * part + 3].copy_from_slice(&turned.to_array());
                }
            }
        }
    }

    /// Sums (or means) of each rig's matrices in its first camera's axes; other entries are unchanged.
    pub(super) fn sums(&self, matrices: &[PoseMatrix], mean: bool) -> Vec<PoseMatrix> {
        let mut out = matrices.to_vec();
        for first in self.firsts() {
            let mut sum = [[0.0; POSE]; POSE];
            let mut count = 0.0;
            for k in self.members(first) {
                let own = turned(&self.turn[k].transpose(), &matrices[k]);
                for (line, own) in sum.iter_mut().zip(own) {
                    for (s, v) in line.iter_mut().zip(own) {
                        *s += v;
                    }
                }
                count += 1.0;
            }
            let part = if mean { 1.0 / count } else { 1.0 };
            out[first] = sum.map(|line| line.map(|v| v * part));
        }
        out
    }

    /// A matrix over the pose of the first camera of `k`'s rig, whose rows are brought to `k`'s axes.
    pub(super) fn rows_at(&self, k: usize, matrices: &[PoseMatrix]) -> PoseMatrix {
        left_turned(&self.turn[k], &matrices[self.first[k]])
    }

    /// A symmetric matrix, transformed on both sides.
    pub(super) fn form_at(&self, k: usize, matrices: &[PoseMatrix]) -> PoseMatrix {
        turned(&self.turn[k], &matrices[self.first[k]])
    }

    /// Places each camera by the first of its rig, so that rounding does not add up.
    pub(super) fn keep(&self, cameras: &mut [Camera]) {
        for k in 0..cameras.len() {
            if self.first[k] != k {
                let turn = glam::DMat4::from_mat3(self.turn[k]);
                cameras[k].viewmat = turn * cameras[self.first[k]].viewmat;
            }
        }
    }
}

fn part_of(row: &[f64; POSE + 1], part: usize) -> DVec3 {
    DVec3::from_slice(&row[3 * part..3 * part + 3])
}

/// `T m`, with T the turn of both halves of a pose.
fn left_turned(turn: &DMat3, m: &PoseMatrix) -> PoseMatrix {
    std::array::from_fn(|i| {
        std::array::from_fn(|j| (0..3).map(|k| turn.col(k)[i % 3] * m[3 * (i / 3) + k][j]).sum())
    })
}

/// `T m T'`.
fn turned(turn: &DMat3, m: &PoseMatrix) -> PoseMatrix {
    let left = left_turned(turn, m);
    std::array::from_fn(|i| {
        std::array::from_fn(|j| (0..3).map(|k| left[i][3 * (j / 3) + k] * turn.col(k)[j % 3]).sum())
    })
}
