//! Draws splats onto a canvas with the blending unit, as quads, back to front.

use bytemuck::{Pod, Zeroable};
use splat_render::gpu::{Gpu, ResidentSplats, ResidentView, shared_wgsl};
use splat_render::io::SplatFile;
use splat_render::{Camera, ProjectOptions, Result};

use crate::display::{Display, Settings};
use crate::pipelines::{Pipeline, storage_layout, uniform, uniform_layout};
use crate::stage_times::{BLEND, PROJECT, SORT, Stamps};
use crate::viewpoint::relative_to;

/// Half floats: precise enough for blending, and every adapter can blend them.
pub const CANVAS: wgpu::TextureFormat = wgpu::TextureFormat::Rgba16Float;

#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
struct Style {
    world_to_camera: [[f32; 4]; 3],
    size: [f32; 2],
    display: u32,
    depth_unit: f32,
    radius: f32,
    unused: [f32; 3],
}

#[derive(Debug)]
pub struct Drawable {
    resident: ResidentSplats,
    origin: [f64; 3],
    antialiased: bool,
    style: wgpu::Buffer,
    bindings: wgpu::BindGroup,
}

impl Drawable {
    pub fn splats(&self) -> &ResidentSplats {
        &self.resident
    }

    /// The camera relative to its origin, and how its splats are projected.
    pub fn seen_from(&self, camera: &Camera, settings: &Settings) -> (Camera, ProjectOptions) {
        let options = ProjectOptions {
            near: settings.near,
            antialiased: self.antialiased,
            ..ProjectOptions::default()
        };
        (relative_to(*camera, self.origin), options)
    }

    /// Sets how the next submission draws it from a camera relative to its origin.
    pub fn set_style(&self, gpu: &Gpu, camera: &Camera, settings: &Settings, depth_unit: f32) {
        let row = |i: usize| camera.viewmat.row(i).to_array().map(|v| v as f32);
        let style = Style {
            world_to_camera: [row(0), row(1), row(2)],
            size: [camera.width as f32, camera.height as f32],
            display: settings.display as u32,
            depth_unit,
            radius: settings.radius,
            unused: [0.0; 3],
        };
        gpu.queue().write_buffer(&self.style, 0, bytemuck::bytes_of(&style));
    }
}

#[derive(Debug)]
pub struct Blending(Pipeline);

impl Blending {
    pub fn new(gpu: &Gpu) -> Self {
        let storage = |binding| storage_layout(binding, wgpu::ShaderStages::VERTEX);
        Self(Pipeline::new(
            gpu,
            "blend",
            shared_wgsl() + include_str!("blend.wgsl"),
            ["corner", "shade"],
            &[
                uniform_layout(0, wgpu::ShaderStages::VERTEX_FRAGMENT),
                storage(1),
                storage(2),
                storage(3),
                storage(4),
            ],
            wgpu::PrimitiveTopology::TriangleStrip,
            wgpu::ColorTargetState {
                format: CANVAS,
                blend: Some(wgpu::BlendState::PREMULTIPLIED_ALPHA_BLENDING),
                write_mask: wgpu::ColorWrites::ALL,
            },
        ))
    }

    pub fn upload(&self, gpu: &Gpu, file: &SplatFile) -> Result<Drawable> {
        let resident = ResidentSplats::new(gpu, &file.splats.params(file.splats.sh_degree))?;
        let style = uniform::<Style>(gpu);
        let buffers =
            [&style, resident.splats2d(), resident.order(), resident.geometry(), resident.quads()];
        let bindings = self.0.bind(gpu, buffers.map(wgpu::Buffer::as_entire_binding));
        gpu.check()?;
        Ok(Drawable {
            resident,
            origin: file.origin,
            antialiased: file.antialiased,
            style,
            bindings,
        })
    }

    /// Draws a model onto columns `begin..end`; depths are in `depth_unit`. Once per model and
    /// submission.
    pub fn record(
        &self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        model: &Drawable,
        camera: &Camera,
        settings: &Settings,
        depth_unit: f32,
        canvas: &wgpu::TextureView,
        [begin, end]: [u32; 2],
        stamps: &Stamps<'_>,
    ) -> Result<()> {
        let (camera, options) = model.seen_from(camera, settings);
        let seen =
            ResidentView { camera: &camera, options: &options, sh_degree: settings.sh_degree };
        model.resident.record(
            gpu,
            encoder,
            &seen,
            [stamps.compute(PROJECT), stamps.compute(SORT)],
        )?;
        model.set_style(gpu, &camera, settings, depth_unit);
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some("blend"),
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: canvas,
                depth_slice: None,
                resolve_target: None,
                ops: wgpu::Operations {
                    load: wgpu::LoadOp::Clear(wgpu::Color::TRANSPARENT),
                    store: wgpu::StoreOp::Store,
                },
            })],
            timestamp_writes: stamps.render(BLEND),
            ..Default::default()
        });
        if begin < end {
            pass.set_scissor_rect(begin, 0, end - begin, camera.height);
            self.draw(&mut pass, model, (model.resident.quads(), 0));
        }
        Ok(())
    }

    /// Draws a model, whose style is set, by the arguments at an offset of a buffer.
    pub fn draw(
        &self,
        pass: &mut wgpu::RenderPass<'_>,
        model: &Drawable,
        arguments: (&wgpu::Buffer, u64),
    ) {
        self.0.draw_indirect(pass, &model.bindings, arguments);
    }
}

impl Settings {
    pub fn is_depth(&self) -> bool {
        self.display == Display::Depth
    }
}
