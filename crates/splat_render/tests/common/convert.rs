//! Conversions between f32 and f64.

use splat_render::SplatGradients;
use splat_render::splats::SplatArrays;
use splat_render::stages::{
    AdamState, DepthLoss, Exposure, ExposureGradients, Image, ImageGradients, Loss, Projected,
    ProjectedGradients,
};

use super::Scene;

/// A number of type A, or arrays and structs of such numbers.
pub trait Convert<A> {
    type With<B>;

    fn convert<B>(&self, to: impl Fn(A) -> B + Copy) -> Self::With<B>;
}

pub fn widen<T: Convert<f32> + ?Sized>(from: &T) -> T::With<f64> {
    from.convert(f64::from)
}

/// Each number becomes the nearest finite f32.
pub fn narrow<T: Convert<f64> + ?Sized>(from: &T) -> T::With<f32> {
    from.convert(|value| (value as f32).clamp(f32::MIN, f32::MAX))
}

impl<A, V: Convert<A>, const K: usize> Convert<A> for [V; K] {
    type With<B> = [V::With<B>; K];

    fn convert<B>(&self, to: impl Fn(A) -> B + Copy) -> Self::With<B> {
        self.each_ref().map(|value| value.convert(to))
    }
}

impl<A, V: Convert<A>> Convert<A> for [V] {
    type With<B> = Vec<V::With<B>>;

    fn convert<B>(&self, to: impl Fn(A) -> B + Copy) -> Self::With<B> {
        self.iter().map(|value| value.convert(to)).collect()
    }
}

impl<A, V: Convert<A>> Convert<A> for Vec<V> {
    type With<B> = Vec<V::With<B>>;

    fn convert<B>(&self, to: impl Fn(A) -> B + Copy) -> Self::With<B> {
        self.as_slice().convert(to)
    }
}

impl<A, V: Convert<A>> Convert<A> for Option<V> {
    type With<B> = Option<V::With<B>>;

    fn convert<B>(&self, to: impl Fn(A) -> B + Copy) -> Self::With<B> {
        self.as_ref().map(|value| value.convert(to))
    }
}

/// For f32 and f64: the number, and structs by their fields to convert and their other fields.
macro_rules! convert {
    ($($kinds:tt)*) => {
        convert_from!(f32; $($kinds)*);
        convert_from!(f64; $($kinds)*);
    };
}

macro_rules! convert_from {
    ($a:ty; $($kind:ident($($field:ident),*; $($same:ident),*);)*) => {
        impl Convert<$a> for $a {
            type With<B> = B;

            fn convert<B>(&self, to: impl Fn($a) -> B + Copy) -> B {
                to(*self)
            }
        }

        $(impl Convert<$a> for $kind<$a> {
            type With<B> = $kind<B>;

            fn convert<B>(&self, to: impl Fn($a) -> B + Copy) -> $kind<B> {
                $kind { $($field: self.$field.convert(to),)* $($same: self.$same,)* }
            }
        })*
    };
}

convert! {
    Scene(means, quats, scales, opacities, colors; sh_degree, sh_stride, raw);
    SplatArrays(means, quats, scales, opacities, sh; sh_degree);
    Projected(means2d, factors, depths, colors, opacities, radii; width, height);
    Image(color, alpha, depth, transmittance; width, height);
    Exposure(gain, offset, background;);
    Loss(value, v_color;);
    DepthLoss(value, v_alpha, v_depth;);
    ImageGradients(v_color, v_alpha, v_depth;);
    ExposureGradients(v_color, v_alpha; v_gain, v_offset);
    ProjectedGradients(
        v_means2d, v_factors, v_depths, v_colors, v_opacities, v_background, v_means2d_absolute;
    );
    SplatGradients(v_means, v_quats, v_scales, v_opacities, v_colors; v_viewmat, v_intrinsics);
    AdamState(splats, first, second;);
}
