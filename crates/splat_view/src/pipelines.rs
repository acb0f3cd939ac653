//! Render pipelines of one WGSL module, and their bindings.

use splat_render::gpu::Gpu;

/// A pass that draws without vertex buffers, into one target.
#[derive(Debug)]
pub struct Pipeline {
    layout: wgpu::BindGroupLayout,
    pipeline: wgpu::RenderPipeline,
}

impl Pipeline {
    /// Compiles `wgsl`, whose entry points are the `vertex` and the `fragment` shader.
    pub fn new(
        gpu: &Gpu,
        label: &str,
        wgsl: String,
        [vertex, fragment]: [&str; 2],
        entries: &[wgpu::BindGroupLayoutEntry],
        topology: wgpu::PrimitiveTopology,
        target: wgpu::ColorTargetState,
    ) -> Self {
        let device = gpu.device();
        let label = Some(label);
        let layout =
            device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor { label, entries });
        let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
            label,
            source: wgpu::ShaderSource::Wgsl(wgsl.into()),
        });
        let pipeline_layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label,
            bind_group_layouts: &[Some(&layout)],
            immediate_size: 0,
        });
        let pipeline = device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
            label,
            layout: Some(&pipeline_layout),
            vertex: wgpu::VertexState {
                module: &module,
                entry_point: Some(vertex),
                compilation_options: Default::default(),
                buffers: &[],
            },
            primitive: wgpu::PrimitiveState { topology, ..Default::default() },
            depth_stencil: None,
            multisample: Default::default(),
            fragment: Some(wgpu::FragmentState {
                module: &module,
                entry_point: Some(fragment),
                compilation_options: Default::default(),
                targets: &[Some(target)],
            }),
            multiview_mask: None,
            cache: None,
        });
        Self { layout, pipeline }
    }

    /// Draws `vertices` of each of `instances` with a group of bindings.
    pub fn draw(
        &self,
        pass: &mut wgpu::RenderPass<'_>,
        bindings: &wgpu::BindGroup,
        vertices: u32,
        instances: u32,
    ) {
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(0, bindings, &[]);
        pass.draw(0..vertices, 0..instances);
    }

    /// Draws as the four numbers at an offset in `arguments` say.
    pub fn draw_indirect(
        &self,
        pass: &mut wgpu::RenderPass<'_>,
        bindings: &wgpu::BindGroup,
        (arguments, offset): (&wgpu::Buffer, u64),
    ) {
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(0, bindings, &[]);
        pass.draw_indirect(arguments, offset);
    }

    /// A group of bindings, of `resources` in their order.
    pub fn bind<const N: usize>(
        &self,
        gpu: &Gpu,
        resources: [wgpu::BindingResource<'_>; N],
    ) -> wgpu::BindGroup {
        let entries: Vec<_> = (0..)
            .zip(resources)
            .map(|(binding, resource)| wgpu::BindGroupEntry { binding, resource })
            .collect();
        gpu.device().create_bind_group(&wgpu::BindGroupDescriptor {
            label: None,
            layout: &self.layout,
            entries: &entries,
        })
    }
}

pub fn uniform_layout(binding: u32, visibility: wgpu::ShaderStages) -> wgpu::BindGroupLayoutEntry {
    buffer_layout(binding, visibility, wgpu::BufferBindingType::Uniform)
}

/// A binding of a storage buffer that is read.
pub fn storage_layout(binding: u32, visibility: wgpu::ShaderStages) -> wgpu::BindGroupLayoutEntry {
    buffer_layout(binding, visibility, wgpu::BufferBindingType::Storage { read_only: true })
}

fn buffer_layout(
    binding: u32,
    visibility: wgpu::ShaderStages,
    ty: wgpu::BufferBindingType,
) -> wgpu::BindGroupLayoutEntry {
    wgpu::BindGroupLayoutEntry {
        binding,
        visibility,
        ty: wgpu::BindingType::Buffer { ty, has_dynamic_offset: false, min_binding_size: None },
        count: None,
    }
}

pub fn uniform<T>(gpu: &Gpu) -> wgpu::Buffer {
    gpu.device().create_buffer(&wgpu::BufferDescriptor {
        label: None,
        size: size_of::<T>() as u64,
        usage: wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST,
        mapped_at_creation: false,
    })
}
