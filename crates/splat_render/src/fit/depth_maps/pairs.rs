//! A photo at several sizes, and how its pixels map to another photo.

use glam::{DMat3, DVec3, Mat3, Vec3};

use super::GrayPhoto;
use super::patch::Texture;

/// A photo at one size. Pixel (0, 0) has its center at (0, 0) here.
pub struct Level {
    pub width: usize,
    pub height: usize,
    pub texture: Texture,
    /// Focal lengths in pixels.
    pub focal: [f32; 2],
    intrinsics: DMat3,
    rotation: DMat3,
    translation: DVec3,
}

impl Level {
    /// Unit normal towards the camera, in its frame, of a plane with this slope (see `Plane`).
    pub fn normal(&self, x: f32, y: f32, [slope_x, slope_y]: [f32; 2]) -> [f32; 3] {
        let ray = (self.intrinsics.inverse() * DVec3::new(x.into(), y.into(), 1.0)).as_vec3();
        let normal = -Vec3::new(slope_x, slope_y, 1.0 - slope_x * ray.x - slope_y * ray.y);
        normal.normalize().into()
    }
}

/// A photo at full size and halved up to `count - 1` times, the smallest first.
pub fn levels(photo: &GrayPhoto, count: usize) -> Vec<Level> {
    let camera = &photo.camera;
    let (mut width, mut height) = (camera.width as usize, camera.height as usize);
    // NaN for pixels that do not count.
    let mut gray = photo.gray.clone();
    for (value, usable) in gray.iter_mut().zip(photo.usable.iter().flatten()) {
        if !usable {
            *value = f32::NAN;
        }
    }
    let mut out = Vec::with_capacity(count);
    let mut scale = 1.0;
    for level in 0..count {
        if level > 0 {
            (gray, width, height) = halved(&gray, width, height);
            scale *= 0.5;
        }
        let byte = |v: &f32| if v.is_nan() { 0 } else { (1.5 + 254.0 * v.clamp(0.0, 1.0)) as u8 };
        let bytes: Vec<u8> = gray.iter().map(byte).collect();
        let (fx, fy) = (scale * camera.fx, scale * camera.fy);
        let (cx, cy) = (scale * camera.cx - 0.5, scale * camera.cy - 0.5);
        out.push(Level {
            width,
            height,
            texture: Texture::new(&bytes, width, height),
            focal: [fx as f32, fy as f32],
            intrinsics: DMat3::from_cols_array(&[fx, 0.0, 0.0, 0.0, fy, 0.0, cx, cy, 1.0]),
            rotation: camera.rotation(),
            translation: camera.translation(),
        });
    }
    out.reverse();
    out
}

/// Means of 2 x 2 pixels; at least three must count.
fn halved(gray: &[f32], width: usize, height: usize) -> (Vec<f32>, usize, usize) {
    let (half_width, half_height) = (width / 2, height / 2);
    let mean = |i: usize| {
        let at = 2 * (i / half_width) * width + 2 * (i % half_width);
        let four = [at, at + 1, at + width, at + width + 1].map(|pixel| gray[pixel]);
        let counted = four.iter().filter(|v| !v.is_nan());
        let (sum, count) = counted.fold((0.0, 0), |(sum, count), v| (sum + v, count + 1));
        if count > 2 { sum / count as f32 } else { f32::NAN }
    };
    ((0..half_width * half_height).map(mean).collect(), half_width, half_height)
}

/// How homogeneous pixels of a photo map to another one.
pub struct Warp {
    /// At infinite depth.
    pub infinite: Mat3,
    /// Added per unit of 1 / depth: the image of the first camera.
    pub epipole: Vec3,
}

impl Warp {
    pub fn new(from: &Level, to: &Level) -> Self {
        let rotation = to.rotation * from.rotation.transpose();
        let translation = to.translation - rotation * from.translation;
        Self {
            infinite: (to.intrinsics * rotation * from.intrinsics.inverse()).as_mat3(),
            epipole: (to.intrinsics * translation).as_vec3(),
        }
    }

    /// The pixel of a point and its z-depth, or None behind the camera.
    #[inline(always)]
    pub fn project(&self, x: f32, y: f32, inverse_depth: f32) -> Option<[f32; 3]> {
        let image = self.infinite * Vec3::new(x, y, 1.0) + self.epipole * inverse_depth;
        let scale = 1.0 / image.z;
        (image.z > 1e-6).then(|| [image.x * scale, image.y * scale, image.z / inverse_depth])
    }
}
