//! Kernels with their bindings, prepared, recorded and submitted.

use std::num::NonZeroU64;
use std::ops::Range;

use rayon::prelude::*;

use super::{Gpu, Pipeline};
use crate::error::Result;
use crate::gpu::kernels::{Access, Kernel, Source};
use crate::gpu::layout::SPLATS_PER_GROUP;

#[derive(Debug, Clone)]
pub(in crate::gpu) struct Bound<'a> {
    buffer: &'a wgpu::Buffer,
    bytes: Option<Range<u64>>,
}

impl<'a> From<&'a wgpu::Buffer> for Bound<'a> {
    fn from(buffer: &'a wgpu::Buffer) -> Self {
        Self { buffer, bytes: None }
    }
}

impl<'a> Bound<'a> {
    /// A part of a buffer, bytes.
    pub fn part(buffer: &'a wgpu::Buffer, bytes: Range<u64>) -> Self {
        Self { buffer, bytes: Some(bytes) }
    }
}

#[derive(Debug, Clone)]
pub(in crate::gpu) enum Groups {
    /// Known when the dispatch is prepared.
    Direct([u32; 2]),
    /// As three numbers at an offset in a buffer say, bytes.
    Indirect(wgpu::Buffer, u64),
}

impl From<[u32; 2]> for Groups {
    fn from(groups: [u32; 2]) -> Self {
        Self::Direct(groups)
    }
}

#[derive(Debug, Clone)]
pub(in crate::gpu) enum Op {
    Dispatch {
        kernel: Kernel,
        /// None if work is only planned.
        run: Option<(wgpu::ComputePipeline, wgpu::BindGroup)>,
        groups: Groups,
    },
    Clear(wgpu::Buffer),
    /// Copies `bytes` bytes between offsets in two buffers.
    Copy {
        from: (wgpu::Buffer, u64),
        to: (wgpu::Buffer, u64),
        bytes: u64,
    },
}

impl Op {
    /// Copies the first bytes of a buffer to an offset in another.
    pub fn copy(from: &wgpu::Buffer, to: &wgpu::Buffer, offset: u64, bytes: u64) -> Self {
        Self::Copy { from: (from.clone(), 0), to: (to.clone(), offset), bytes }
    }

    /// The entry point of the kernel, "clear" or "copy".
    pub fn name(&self) -> &'static str {
        match self {
            Self::Dispatch { kernel, .. } => kernel.entry(),
            Self::Clear(_) => "clear",
            Self::Copy { .. } => "copy",
        }
    }
}

impl Gpu {
    fn pipeline(&self, kernel: Kernel) -> &Pipeline {
        self.pipelines[kernel as usize].get_or_init(|| {
            let (source, entry) = (kernel.source(), kernel.entry());
            self.count(0);
            let text = self.injected.text(source.text(self.build));
            let descriptor = wgpu::ShaderModuleDescriptor {
                label: Some(source.name),
                source: wgpu::ShaderSource::Wgsl(text.into()),
            };
            let checks = wgpu::ShaderRuntimeChecks {
                bounds_checks: self.checks_shaders,
                force_loop_bounding: self.checks_shaders,
                int_div_checks: self.checks_shaders,
                ..wgpu::ShaderRuntimeChecks::checked()
            };
            // SAFETY: the text is this crate's. Its loops are counting ones (a test of gpu/kernels looks
            // at their heads); it divides integers by constants and sizes above 0; and it indexes by
            // counts on the device that fit the buffers: if the pairs of a chunk do not, bin_scan makes
            // their number 0 and the dispatches that follow empty.
            let module = unsafe { self.device.create_shader_module_trusted(descriptor, checks) };
            let bindings = bind_group_layout(&self.device, source);
            let layout = self.device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
                label: Some(source.name),
                bind_group_layouts: &[Some(&bindings)],
                immediate_size: 0,
            });
            let constants = source.constants(self.build);
            let pipeline = self.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
                label: Some(entry),
                layout: Some(&layout),
                module: &module,
                entry_point: Some(entry),
                compilation_options: wgpu::PipelineCompilationOptions {
                    constants: &constants,
                    // No kernel uses workgroup memory that it has not written.
                    zero_initialize_workgroup_memory: self.checks_shaders,
                },
                cache: None,
            });
            (pipeline, bindings)
        })
    }

    /// Compiles every kernel, several at once.
    pub fn compile_all(&self) -> Result<()> {
        Kernel::ALL.par_iter().for_each(|&kernel| {
            self.pipeline(kernel);
        });
        self.check()
    }

    /// Prepares a kernel on its bindings, in the order of their numbers.
    pub(in crate::gpu) fn op(
        &self,
        kernel: Kernel,
        bindings: &[Bound<'_>],
        groups: impl Into<Groups>,
    ) -> Op {
        let groups = groups.into();
        if self.plans_only {
            return Op::Dispatch { kernel, run: None, groups };
        }
        let entries: Vec<_> = bindings
            .iter()
            .enumerate()
            .map(|(i, bound)| wgpu::BindGroupEntry {
                binding: i as u32,
                resource: wgpu::BindingResource::Buffer(wgpu::BufferBinding {
                    buffer: bound.buffer,
                    offset: bound.bytes.as_ref().map_or(0, |b| b.start),
                    size: bound.bytes.as_ref().and_then(|b| NonZeroU64::new(b.end - b.start)),
                }),
            })
            .collect();
        let (pipeline, layout) = self.pipeline(kernel);
        self.count(0);
        let bind_group = self.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some(kernel.entry()),
            layout,
            entries: &entries,
        });
        Op::Dispatch { kernel, run: Some((pipeline.clone(), bind_group)), groups }
    }

    /// Workgroups for `count` invocations or tiles, spilling into y past the limit of x.
    pub(in crate::gpu) fn groups(&self, count: u32, per_group: u32) -> [u32; 2] {
        let groups = count.div_ceil(per_group).max(1);
        let x = groups.min(self.groups_max);
        [x, groups.div_ceil(x)]
    }

    /// Ranges of splats so small that `bytes_per_splat` times their number can be bound at once.
    pub(in crate::gpu) fn windows(&self, splats: u32, bytes_per_splat: u64) -> Vec<Range<u32>> {
        let fit = (self.binding_limit / bytes_per_splat).min(u64::from(u32::MAX / 2)) as u32;
        let step = (fit / SPLATS_PER_GROUP).max(1) * SPLATS_PER_GROUP;
        (0..splats).step_by(step as usize).map(|b| b..(b + step).min(splats)).collect()
    }

    pub(in crate::gpu) fn record(encoder: &mut wgpu::CommandEncoder, ops: &[Op]) {
        let mut rest = ops;
        while let Some(first) = rest.first() {
            match first {
                Op::Dispatch { .. } => {}
                Op::Clear(buffer) => encoder.clear_buffer(buffer, 0, None),
                Op::Copy { from, to, bytes } => {
                    encoder.copy_buffer_to_buffer(&from.0, from.1, &to.0, to.1, *bytes);
                }
            }
            let run = rest.iter().take_while(|op| matches!(op, Op::Dispatch { .. })).count();
            if run == 0 {
                rest = &rest[1..];
                continue;
            }
            Self::record_pass(encoder, &rest[..run], None);
            rest = &rest[run..];
        }
    }

    /// Records the dispatches among prepared commands as one pass.
    pub(in crate::gpu) fn record_pass(
        encoder: &mut wgpu::CommandEncoder,
        ops: &[Op],
        timestamp_writes: Option<wgpu::ComputePassTimestampWrites<'_>>,
    ) {
        let mut pass = encoder
            .begin_compute_pass(&wgpu::ComputePassDescriptor { label: None, timestamp_writes });
        for op in ops {
            if let Op::Dispatch { run: Some((pipeline, bind_group)), groups, .. } = op {
                pass.set_pipeline(pipeline);
                pass.set_bind_group(0, bind_group, &[]);
                match groups {
                    Groups::Direct([x, y]) => pass.dispatch_workgroups(*x, *y, 1),
                    Groups::Indirect(buffer, at) => pass.dispatch_workgroups_indirect(buffer, *at),
                }
            }
        }
    }

    /// Runs lists of prepared commands, without waiting for them.
    pub(in crate::gpu) fn submit(&self, lists: &[&[Op]]) -> Result<wgpu::SubmissionIndex> {
        if self.submission_fails() {
            return Err(self.error("is out of memory"));
        }
        let mut encoder = self.device.create_command_encoder(&Default::default());
        for ops in lists {
            Self::record(&mut encoder, ops);
        }
        let submission = self.queue.submit([encoder.finish()]);
        self.check()?;
        Ok(submission)
    }
}

fn bind_group_layout(device: &wgpu::Device, source: &Source) -> wgpu::BindGroupLayout {
    let entries: Vec<_> = source
        .bindings
        .iter()
        .enumerate()
        .map(|(i, access)| wgpu::BindGroupLayoutEntry {
            binding: i as u32,
            visibility: wgpu::ShaderStages::COMPUTE,
            ty: wgpu::BindingType::Buffer {
                ty: match access {
                    Access::Uniform => wgpu::BufferBindingType::Uniform,
                    Access::Read => wgpu::BufferBindingType::Storage { read_only: true },
                    Access::Write => wgpu::BufferBindingType::Storage { read_only: false },
                },
                has_dynamic_offset: false,
                min_binding_size: None,
            },
            count: None,
        })
        .collect();
    device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
        label: Some(source.name),
        entries: &entries,
    })
}
