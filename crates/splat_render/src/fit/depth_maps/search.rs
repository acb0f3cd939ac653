//! The search for the plane of each pixel of a photo.

use glam::Vec3;
use pulp::{Simd, WithSimd};
use rayon::prelude::*;

use super::pairs::{Level, Warp};
use super::patch::{Patch, Texture, UNSEEN};
use super::{MAX_OTHERS, Search};
use crate::cpu::dispatch;

/// Pixels whose planes are tried, aside and ahead in four directions: the best of a widening ray, and the
/// best of those straight on (Xu and Tao 2019).
const NEAR: [[i32; 2]; 7] = [[0, 1], [1, 2], [-1, 2], [2, 3], [-2, 3], [3, 4], [-3, 4]];
const FAR: [[i32; 2]; 7] = [[0, 3], [0, 5], [0, 7], [0, 11], [0, 15], [0, 19], [0, 23]];
/// Score that a depth loses which another photo's map contradicts, by the distance in pixels that a pixel
/// is off after it was projected to that photo and, with its depth there, back.
const CONTRADICTED: f32 = 0.2;
const MAX_OFF_PX: f32 = 3.0;
/// Maximum random change of depths, in pixels that it moves a pixel's image in another photo.
const MAX_CHANGE_PX: f32 = 4.0;
/// Distance of the depths nearby that find the best one, in such pixels.
const CLIMB_PX: f32 = 0.4;
/// Maximum slope of planes: tangent of the angle between normal and ray.
const MAX_SLOPE: f32 = 4.0;
const MAX_RANDOM_SLOPE: f32 = 2.0;
/// Planes within this many pixels in other photos and this slope are the same.
const SAME: f32 = 0.02;

/// A plane through the ray of a pixel.
#[derive(Debug, Clone, Copy, Default)]
pub struct Plane {
    /// At the pixel.
    pub inverse_depth: f32,
    /// Relative change of the inverse depth per unit of the image plane at depth 1, along x and y.
    pub slope: [f32; 2],
}

impl Plane {
    /// The same plane at the ray of a pixel at this distance in pixels, or None.
    #[inline(always)]
    fn moved(self, x: f32, y: f32, [fx, fy]: [f32; 2]) -> Option<Self> {
        let factor = 1.0 + self.slope[0] * x / fx + self.slope[1] * y / fy;
        (factor > 1e-3).then(|| Self {
            inverse_depth: self.inverse_depth * factor,
            slope: self.slope.map(|v| v / factor),
        })
    }
}

/// The planes of a photo's pixels.
#[derive(Debug, Clone)]
pub struct PlaneMap {
    pub width: usize,
    pub height: usize,
    pub planes: Vec<Plane>,
    /// Mean correlation with the best photos in -1..=1, less the loss by other maps.
    pub scores: Vec<f32>,
}

impl PlaneMap {
    #[inline(always)]
    fn index(&self, column: i32, row: i32) -> Option<usize> {
        let is_inside =
            (0..self.width as i32).contains(&column) && (0..self.height as i32).contains(&row);
        is_inside.then(|| row as usize * self.width + column as usize)
    }
}

/// Another photo.
pub struct Pair<'a> {
    pub level: &'a Level,
    pub there: Warp,
    pub back: Warp,
    /// Which depth map is its.
    pub map: Option<usize>,
}

/// A photo's search at one size.
pub struct Stage<'a> {
    pub own: &'a Level,
    pub pairs: Vec<Pair<'a>>,
    range: [f32; 2],
    /// Distinguishes random numbers of photos and levels.
    stream: u32,
}

impl<'a> Stage<'a> {
    /// `maps` has the index of each photo's map.
    pub fn new(levels: &[&'a Level], search: &Search, maps: &[Option<usize>], size: u32) -> Self {
        let own = levels[search.photo];
        let pair = |&photo: &usize| {
            let level = levels[photo];
            let (there, back) = (Warp::new(own, level), Warp::new(level, own));
            Pair { level, there, back, map: maps[photo] }
        };
        Self {
            own,
            pairs: search.others.iter().map(pair).collect(),
            range: search.range,
            stream: hash(size * 0x1_0000 + search.photo as u32),
        }
    }

    /// Random planes, or of the depth of the seeds.
    pub fn random(&self, seeds: &[[f32; 3]], scale: f32) -> PlaneMap {
        let (width, height) = (self.own.width, self.own.height);
        let [near, far] = self.range;
        let plane = |pixel| {
            let mut random = Random::new(self.stream, 0, pixel);
            let inverse_depth = far + (near - far) * random.uniform();
            Plane { inverse_depth, slope: random.direction().map(|v| MAX_RANDOM_SLOPE * v) }
        };
        let mut planes: Vec<Plane> = (0..width * height).map(plane).collect();
        for &[column, row, inverse_depth] in seeds {
            let (column, row) = ((column * scale) as usize, (row * scale) as usize);
            if column < width && row < height {
                planes[row * width + column].inverse_depth = inverse_depth.clamp(far, near);
            }
        }
        PlaneMap { width, height, planes, scores: vec![UNSEEN; width * height] }
    }

    /// The planes of a photo of half the size.
    pub fn doubled(&self, coarse: &PlaneMap) -> PlaneMap {
        let (width, height) = (self.own.width, self.own.height);
        let planes = (0..width * height).map(|pixel| {
            let (column, row) = (pixel % width, pixel / width);
            let (left, upper) =
                ((column / 2).min(coarse.width - 1), (row / 2).min(coarse.height - 1));
            let plane = coarse.planes[upper * coarse.width + left];
            let x = column as f32 - (2.0 * left as f32 + 0.5);
            let y = row as f32 - (2.0 * upper as f32 + 0.5);
            plane.moved(x, y, self.own.focal).unwrap_or(plane)
        });
        PlaneMap { width, height, planes: planes.collect(), scores: vec![UNSEEN; width * height] }
    }

    /// Improves planes; `maps` are those of all photos, or none to search without them.
    pub fn run(&self, mut map: PlaneMap, maps: &[PlaneMap], iterations: usize) -> PlaneMap {
        let width = self.own.width;
        for turn in 0..=2 * iterations {
            // The first turn only scores the given planes.
            let color = (turn > 0).then_some(turn % 2);
            let mut planes = map.planes.clone();
            let mut scores = map.scores.clone();
            let rows = planes.par_chunks_mut(width).zip(scores.par_chunks_mut(width)).enumerate();
            rows.for_each(|(row, (planes, scores))| {
                dispatch(Row { stage: self, map: &map, maps, row, color, turn, planes, scores });
            });
            map.planes = planes;
            map.scores = scores;
        }
        map
    }
}

/// A row of one iteration, compiled for the machine's widest instruction set.
struct Row<'a> {
    stage: &'a Stage<'a>,
    map: &'a PlaneMap,
    maps: &'a [PlaneMap],
    row: usize,
    /// Parity of the pixels to search; None to score all pixels' planes.
    color: Option<usize>,
    turn: usize,
    planes: &'a mut [Plane],
    scores: &'a mut [f32],
}

impl WithSimd for Row<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let (stage, map) = (self.stage, self.map);
        let step = if self.color.is_some() { 2 } else { 1 };
        let start = self.color.map_or(0, |color| (self.row + color) % 2);
        for column in (start..map.width).step_by(step) {
            let at = self.row * map.width + column;
            if !stage.own.texture.counts(at) {
                continue;
            }
            let mut pixel = Pixel::new(&self, column, map.planes[at]);
            if self.color.is_some() {
                pixel.score = map.scores[at];
                pixel.take_from_nearby(map);
                let random = Random::new(stage.stream, self.turn as u32, at);
                pixel.vary(random, self.maps.is_empty());
            } else {
                pixel.score = pixel.score_of(pixel.plane);
            }
            self.planes[column] = pixel.plane;
            self.scores[column] = pixel.score;
        }
    }
}

/// A pixel and its best plane so far.
struct Pixel<'a> {
    stage: &'a Stage<'a>,
    maps: &'a [PlaneMap],
    column: usize,
    row: usize,
    patch: Patch,
    /// Homogeneous images of the pixel at infinite depth, in other photos.
    infinite: [Vec3; MAX_OTHERS],
    /// Relative change of the inverse depth that moves the pixel's image by one pixel, in the photo
    /// with the largest motion.
    step: f32,
    plane: Plane,
    score: f32,
}

impl<'a> Pixel<'a> {
    #[inline(always)]
    fn new(row: &Row<'a>, column: usize, plane: Plane) -> Self {
        let &Row { stage, maps, row, .. } = row;
        let at = Vec3::new(column as f32, row as f32, 1.0);
        let mut infinite = [Vec3::ZERO; MAX_OTHERS];
        let mut most = 1e-6f32;
        for (pair, infinite) in stage.pairs.iter().zip(&mut infinite) {
            *infinite = pair.there.infinite * at;
            let image = *infinite + pair.there.epipole * plane.inverse_depth;
            if image.z > 1e-6 {
                let along = pair.there.epipole - image * (pair.there.epipole.z / image.z);
                most = most.max(along.x.hypot(along.y) * plane.inverse_depth / image.z);
            }
        }
        let patch = Patch::at(&stage.own.texture, column, row);
        Self { stage, maps, column, row, patch, infinite, step: 1.0 / most, plane, score: UNSEEN }
    }

    /// Tries the best plane of each group of pixels. They have the opposite color.
    #[inline(always)]
    fn take_from_nearby(&mut self, map: &PlaneMap) {
        let (column, row) = (self.column as i32, self.row as i32);
        for [cos, sin] in [[1, 0], [0, 1], [-1, 0], [0, -1]] {
            for group in [&NEAR, &FAR] {
                let mut best = (UNSEEN, None);
                for &[aside, ahead] in group {
                    let (x, y) = (aside * cos - ahead * sin, aside * sin + ahead * cos);
                    if let Some(at) = map.index(column + x, row + y)
                        && map.scores[at] > best.0
                    {
                        let moved =
                            map.planes[at].moved(-x as f32, -y as f32, self.stage.own.focal);
                        best = (map.scores[at], moved);
                    }
                }
                if let Some(plane) = best.1 {
                    self.try_plane(plane);
                }
            }
        }
    }

    /// Tries random changes of the plane, or `is_free` also other planes.
    #[inline(always)]
    fn vary(&mut self, mut random: Random, is_free: bool) {
        let [near, far] = self.stage.range;
        if is_free {
            let slope = random.direction().map(|v| MAX_RANDOM_SLOPE * v);
            let inverse_depth = far + (near - far) * random.uniform();
            self.try_plane(Plane { inverse_depth, slope: self.plane.slope });
            self.try_plane(Plane { inverse_depth, slope });
        }
        if !is_free {
            // The top of the parabola through the score and the scores of two depths nearby.
            let (plane, change) = (self.plane, CLIMB_PX * self.step);
            let near =
                |way| Plane { inverse_depth: plane.inverse_depth * (1.0 + way * change), ..plane };
            let (less, more) = (self.score_of(near(-1.0)), self.score_of(near(1.0)));
            let bend = (2.0 * self.score - less - more).max(1e-6);
            self.try_plane(near((0.5 * (more - less) / bend).clamp(-1.5, 1.5)));
        }
        for kind in 0..3 {
            let mut plane = self.plane;
            if kind != 1 {
                // Large and small changes alike.
                let pixels = MAX_CHANGE_PX * 0.02f32.powf(random.uniform());
                let sign = if random.uniform() < 0.5 { -1.0 } else { 1.0 };
                plane.inverse_depth *= 1.0 + sign * self.step * pixels;
            }
            if kind != 0 {
                let length = 0.05f32.powf(random.uniform());
                let [x, y] = random.direction();
                plane.slope = [plane.slope[0] + length * x, plane.slope[1] + length * y];
            }
            self.try_plane(plane);
        }
    }

    #[inline(always)]
    fn try_plane(&mut self, plane: Plane) {
        let [near, far] = self.stage.range;
        let Plane { inverse_depth, slope } = plane;
        let change = (inverse_depth - self.plane.inverse_depth).abs() / self.plane.inverse_depth;
        let turn = (slope[0] - self.plane.slope[0]).abs() + (slope[1] - self.plane.slope[1]).abs();
        let is_same = change < SAME * self.step && turn < SAME;
        let is_steep = slope[0].hypot(slope[1]) > MAX_SLOPE;
        if is_same || is_steep || !(far..=near).contains(&inverse_depth) {
            return;
        }
        let score = self.score_of(plane);
        if score > self.score {
            (self.plane, self.score) = (plane, score);
        }
    }

    /// Mean score of the two photos that agree best, since some may not see the surface.
    #[inline(always)]
    fn score_of(&self, plane: Plane) -> f32 {
        let [fx, fy] = self.stage.own.focal;
        let (x, y) = (self.column as f32, self.row as f32);
        let dx = plane.inverse_depth * plane.slope[0] / fx;
        let dy = plane.inverse_depth * plane.slope[1] / fy;
        let at_origin = plane.inverse_depth - dx * x - dy * y;
        let (mut first, mut second) = (UNSEEN, UNSEEN);
        for (pair, infinite) in self.stage.pairs.iter().zip(&self.infinite) {
            let Warp { infinite: turned, epipole } = &pair.there;
            let image = *infinite + *epipole * plane.inverse_depth;
            // Its camera must be on the same side of the plane.
            if image.z < 1e-6 || Vec3::new(dx, dy, at_origin).dot(pair.back.epipole) > 0.98 {
                continue;
            }
            let texture: &Texture = &pair.level.texture;
            let along = (turned.x_axis + *epipole * dx, turned.y_axis + *epipole * dy);
            let mut score = self.patch.correlation(texture, image, along.0, along.1);
            if score > UNSEEN
                && let Some(map) = pair.map.and_then(|map| self.maps.get(map))
            {
                let at = image * (1.0 / image.z);
                let off = there_and_back(pair, map, at.x, at.y)
                    .map_or(MAX_OFF_PX, |[back_x, back_y, _]| (back_x - x).hypot(back_y - y))
                    .min(MAX_OFF_PX);
                score = (score - CONTRADICTED / MAX_OFF_PX * off).max(-0.99);
            }
            second = second.max(first.min(score));
            first = first.max(score);
        }
        if second > UNSEEN { 0.5 * (first + second) } else { first }
    }
}

/// The pixel and depth in the first photo of the surface that another photo's map has at (x, y), or None.
#[inline(always)]
pub fn there_and_back(pair: &Pair<'_>, map: &PlaneMap, x: f32, y: f32) -> Option<[f32; 3]> {
    let (column, row) = ((x + 0.5).floor(), (y + 0.5).floor());
    let at = map.index(column as i32, row as i32).filter(|&at| map.scores[at] > UNSEEN)?;
    let plane = map.planes[at].moved(x - column, y - row, pair.level.focal)?;
    pair.back.project(x, y, plane.inverse_depth)
}

/// Random numbers that depend on the pixel and the turn alone.
struct Random(u32);

impl Random {
    #[inline(always)]
    fn new(stream: u32, turn: u32, pixel: usize) -> Self {
        Self(hash(stream ^ hash(turn.wrapping_mul(0x9E37_79B9) ^ hash(pixel as u32))))
    }

    /// In 0..1.
    #[inline(always)]
    fn uniform(&mut self) -> f32 {
        self.0 = hash(self.0.wrapping_add(0x9E37_79B9));
        (self.0 >> 8) as f32 * (1.0 / 16_777_216.0)
    }

    /// A vector in the unit disc, evenly distributed.
    #[inline(always)]
    fn direction(&mut self) -> [f32; 2] {
        loop {
            let [x, y] = [2.0 * self.uniform() - 1.0, 2.0 * self.uniform() - 1.0];
            if x * x + y * y <= 1.0 {
                return [x, y];
            }
        }
    }
}

/// Mixes the bits of a number (Wellons 2018, "lowbias32").
#[inline(always)]
fn hash(mut bits: u32) -> u32 {
    bits = (bits ^ (bits >> 16)).wrapping_mul(0x7FEB_352D);
    bits = (bits ^ (bits >> 15)).wrapping_mul(0x846C_A68B);
    bits ^ (bits >> 16)
}
