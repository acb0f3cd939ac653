//! How splats are displayed.

/// Kinds of pictures, in the order of the constants in `blend.wgsl`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[repr(u32)]
pub enum Display {
    #[default]
    Splats,
    Points,
    /// Each as a solid ellipse, 1.5 standard deviations wide.
    Ellipses,
    Depth,
    /// Each splat's shortest axis, in camera axes.
    Normals,
}

impl Display {
    pub const ALL: [(Self, &str); 5] = [
        (Self::Splats, "Splats"),
        (Self::Points, "Points"),
        (Self::Ellipses, "Ellipses"),
        (Self::Depth, "Depth"),
        (Self::Normals, "Normals"),
    ];
}

/// Renderer of the display `Splats`; blending draws the remaining displays.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Drawing {
    /// The rasterizer on software adapters, else the renderer of the fastest frames.
    #[default]
    Auto,
    Rasterizer,
    Blending,
}

impl Drawing {
    pub const ALL: [(Self, &str); 3] =
        [(Self::Auto, "auto"), (Self::Rasterizer, "rasterize"), (Self::Blending, "blend")];
}

/// How a picture is drawn.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    pub display: Display,
    pub drawing: Drawing,
    /// Highest SH degree that is evaluated.
    pub sh_degree: u32,
    /// Vertical field of view, radians.
    pub fov: f64,
    /// Near plane, world units.
    pub near: f32,
    pub background: [f32; 3],
    /// Radius of points in pixels.
    pub radius: f32,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            display: Display::Splats,
            drawing: Drawing::Auto,
            sh_degree: splat_render::constants::SH_DEGREE_MAX,
            fov: 50f64.to_radians(),
            near: splat_render::constants::NEAR,
            background: [0.0; 3],
            radius: 1.5,
        }
    }
}
