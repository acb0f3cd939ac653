//! Draws splats onto a canvas with the renderer's rasterizer. The picture stays on the device.

use bytemuck::{Pod, Zeroable};
use splat_render::gpu::{Gpu, ResidentPicture, ResidentView};
use splat_render::{Camera, Result};

use crate::blending::{Blending, CANVAS, Drawable};
use crate::display::Settings;
use crate::pipelines::{Pipeline, storage_layout, uniform, uniform_layout};
use crate::stage_times::{BIN, CANVAS as CANVAS_STAGE, PROJECT, RASTERIZE, SORT, Stamps};

/// A range of a canvas's columns.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
struct Place {
    begin: u32,
    width: u32,
}

/// Buffers for the rasterizer's picture of a canvas.
#[derive(Debug)]
pub struct PictureBuffers {
    /// Width and height in pixels of the largest picture.
    pub size: [u32; 2],
    picture: ResidentPicture,
    place: wgpu::Buffer,
    bindings: wgpu::BindGroup,
}

#[derive(Debug)]
pub struct Rasterizing(Pipeline);

impl Rasterizing {
    pub fn new(gpu: &Gpu) -> Self {
        let stage = wgpu::ShaderStages::FRAGMENT;
        Self(Pipeline::new(
            gpu,
            "canvas",
            include_str!("canvas.wgsl").into(),
            ["cover", "lay"],
            &[uniform_layout(0, stage), storage_layout(1, stage)],
            wgpu::PrimitiveTopology::TriangleList,
            CANVAS.into(),
        ))
    }

    /// Allocates buffers for pictures up to a size.
    pub fn buffers(&self, gpu: &Gpu, size: [u32; 2]) -> Result<PictureBuffers> {
        let picture = ResidentPicture::new(gpu, size[0], size[1])?;
        let place = uniform::<Place>(gpu);
        let buffers = [&place, picture.picture()];
        let bindings = self.0.bind(gpu, buffers.map(wgpu::Buffer::as_entire_binding));
        Ok(PictureBuffers { size, picture, place, bindings })
    }

    /// Whether the next picture has room for pairs that an earlier one had not.
    pub fn is_short(gpu: &Gpu, buffers: &mut PictureBuffers) -> bool {
        buffers.picture.is_short(gpu)
    }

    /// Draws a model onto columns `begin..end` of a canvas and submits the work. Blending draws it if there
    /// was no room for its pairs.
    pub fn draw(
        &self,
        gpu: &Gpu,
        blending: &Blending,
        model: &Drawable,
        buffers: &mut PictureBuffers,
        camera: &Camera,
        settings: &Settings,
        canvas: &wgpu::TextureView,
        [begin, end]: [u32; 2],
        stamps: &Stamps<'_>,
    ) -> Result<()> {
        let (camera, options) = model.seen_from(camera, settings);
        let mut encoder = gpu.device().create_command_encoder(&Default::default());
        let seen =
            ResidentView { camera: &camera, options: &options, sh_degree: settings.sh_degree };
        buffers.picture.record(
            gpu,
            &mut encoder,
            model.splats(),
            &seen,
            begin..end,
            [PROJECT, SORT, BIN, RASTERIZE].map(|stage| stamps.compute(stage)),
        )?;
        model.set_style(gpu, &camera, settings, 1.0);
        let columns = Place { begin, width: end - begin };
        gpu.queue().write_buffer(&buffers.place, 0, bytemuck::bytes_of(&columns));
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some("canvas"),
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: canvas,
                depth_slice: None,
                resolve_target: None,
                ops: wgpu::Operations {
                    load: wgpu::LoadOp::Clear(wgpu::Color::TRANSPARENT),
                    store: wgpu::StoreOp::Store,
                },
            })],
            timestamp_writes: stamps.render(CANVAS_STAGE),
            ..Default::default()
        });
        pass.set_scissor_rect(begin, 0, end - begin, camera.height);
        let (arguments, [picture, quads]) = ResidentPicture::draws(model.splats());
        self.0.draw_indirect(&mut pass, &buffers.bindings, (arguments, picture));
        // Splats are projected to these columns, and the style is the whole canvas's.
        pass.set_viewport(begin as f32, 0.0, camera.width as f32, camera.height as f32, 0.0, 1.0);
        blending.draw(&mut pass, model, (arguments, quads));
        drop(pass);
        gpu.queue().submit([encoder.finish()]);
        buffers.picture.submitted();
        gpu.check()
    }
}
