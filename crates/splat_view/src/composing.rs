//! Composes canvases over the background, into a window or a picture.

use bytemuck::{Pod, Zeroable};
use splat_render::gpu::Gpu;

use crate::blending::CANVAS;
use crate::pipelines::{Pipeline, uniform, uniform_layout};

/// Settings of the composition, as the shader has them.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub struct Look {
    pub background: [f32; 3],
    /// First pixel column of the second canvas.
    pub divider: f32,
    /// 1 if the canvases hold depths.
    pub is_depth: u32,
    /// Depths at the ends of the color map, in the canvases' unit.
    pub depth_range: [f32; 2],
    /// Fills the struct up to its size in WGSL.
    pub padding: f32,
}

/// Textures that splats are drawn to, for one model or two side by side.
#[derive(Debug)]
pub struct Canvases {
    pub size: [u32; 2],
    /// Both are the same if there is one model.
    pub textures: [wgpu::Texture; 2],
    pub views: [wgpu::TextureView; 2],
    look: wgpu::Buffer,
    bindings: wgpu::BindGroup,
}

#[derive(Debug)]
pub struct Composing(Pipeline);

impl Composing {
    pub fn new(gpu: &Gpu, format: wgpu::TextureFormat) -> Self {
        let texture = |binding| wgpu::BindGroupLayoutEntry {
            binding,
            visibility: wgpu::ShaderStages::FRAGMENT,
            ty: wgpu::BindingType::Texture {
                sample_type: wgpu::TextureSampleType::Float { filterable: false },
                view_dimension: wgpu::TextureViewDimension::D2,
                multisampled: false,
            },
            count: None,
        };
        Self(Pipeline::new(
            gpu,
            "compose",
            include_str!("compose.wgsl").into(),
            ["cover", "compose"],
            &[uniform_layout(0, wgpu::ShaderStages::FRAGMENT), texture(1), texture(2)],
            wgpu::PrimitiveTopology::TriangleList,
            format.into(),
        ))
    }

    /// Canvases of a size, for one model or two.
    pub fn canvases(&self, gpu: &Gpu, size: [u32; 2], two: bool) -> Canvases {
        let texture = || {
            gpu.device().create_texture(&wgpu::TextureDescriptor {
                label: Some("canvas"),
                size: wgpu::Extent3d { width: size[0], height: size[1], depth_or_array_layers: 1 },
                mip_level_count: 1,
                sample_count: 1,
                dimension: wgpu::TextureDimension::D2,
                format: CANVAS,
                usage: wgpu::TextureUsages::RENDER_ATTACHMENT
                    | wgpu::TextureUsages::TEXTURE_BINDING
                    | wgpu::TextureUsages::COPY_SRC,
                view_formats: &[],
            })
        };
        let first = texture();
        let textures = [first.clone(), if two { texture() } else { first }];
        let views = textures.each_ref().map(|texture| texture.create_view(&Default::default()));
        let look = uniform::<Look>(gpu);
        let view = |view| wgpu::BindingResource::TextureView(view);
        let bindings =
            self.0.bind(gpu, [look.as_entire_binding(), view(&views[0]), view(&views[1])]);
        Canvases { size, textures, views, look, bindings }
    }

    pub fn record(
        &self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        canvases: &Canvases,
        look: &Look,
        target: &wgpu::TextureView,
        timestamp_writes: Option<wgpu::RenderPassTimestampWrites<'_>>,
    ) {
        gpu.queue().write_buffer(&canvases.look, 0, bytemuck::bytes_of(look));
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some("compose"),
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: target,
                depth_slice: None,
                resolve_target: None,
                ops: wgpu::Operations {
                    load: wgpu::LoadOp::Clear(wgpu::Color::BLACK),
                    store: wgpu::StoreOp::Store,
                },
            })],
            timestamp_writes,
            ..Default::default()
        });
        self.0.draw(&mut pass, &canvases.bindings, 3, 1);
    }
}
