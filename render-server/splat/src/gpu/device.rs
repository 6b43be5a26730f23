//! Selection of the adapter, and the device on it.
//!
//! Devices fail: drivers reset, cards are unplugged, memory runs out. Every error is stored in one place
//! ([`Device::fault`]), which is checked after each tick; nothing panics.

#![allow(unsafe_code, reason = "shaders without counters in their loops, a tenth faster on a card")]

use std::future::Future;
use std::num::NonZero;
use std::pin::pin;
use std::sync::{Arc, OnceLock};
use std::task::{Context, Poll, Waker};

use super::limits::Budget;

/// Name and kind of an adapter, for reports.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AdapterName {
    /// Name from the driver, with the interface: `NVIDIA GeForce RTX 3080 (Vulkan)`.
    pub name: String,
    /// Whether it is a software renderer on the processor (llvmpipe, SwiftShader, WARP).
    pub is_software: bool,
}

/// Adapter that can render.
#[derive(Debug)]
pub struct Adapter {
    inner: wgpu::Adapter,
    name: AdapterName,
}

impl Adapter {
    /// Returns all adapters that can render, the presumably fastest first.
    pub fn all() -> Vec<Self> {
        // No validation of indirect dispatches: their arguments are computed by this renderer's shaders, and limited
        // by the buffers.
        let instance = wgpu::Instance::new(wgpu::InstanceDescriptor {
            flags: wgpu::InstanceFlags::empty(),
            ..wgpu::InstanceDescriptor::new_without_display_handle()
        });
        let mut adapters: Vec<_> = ready(instance.enumerate_adapters(wgpu::Backends::all()))
            .into_iter()
            .filter(|adapter| {
                let downlevel = adapter.get_downlevel_capabilities();
                downlevel.flags.contains(
                    wgpu::DownlevelFlags::COMPUTE_SHADERS
                        | wgpu::DownlevelFlags::INDIRECT_EXECUTION,
                ) && wgpu::Limits::default().check_limits(&adapter.limits())
            })
            .collect();
        adapters.sort_by_key(|adapter| match adapter.get_info().device_type {
            wgpu::DeviceType::DiscreteGpu => 0,
            wgpu::DeviceType::IntegratedGpu => 1,
            wgpu::DeviceType::VirtualGpu => 2,
            wgpu::DeviceType::Other => 3,
            wgpu::DeviceType::Cpu => 4,
        });
        let named = |inner: wgpu::Adapter| {
            let info = inner.get_info();
            let name = format!("{} ({:?})", info.name, info.backend);
            let is_software = info.device_type == wgpu::DeviceType::Cpu;
            Self { inner, name: AdapterName { name, is_software } }
        };
        adapters.into_iter().map(named).collect()
    }

    /// Returns the name and kind of the adapter.
    pub fn name(&self) -> &AdapterName {
        &self.name
    }

    /// Opens a device with the adapter's own limits for buffers.
    pub(super) fn open(&self, budget: &Budget) -> Result<Device, String> {
        let adapter = &self.inner;
        let best = adapter.limits();
        let limits = wgpu::Limits {
            max_buffer_size: best.max_buffer_size,
            max_storage_buffer_binding_size: best.max_storage_buffer_binding_size,
            ..wgpu::Limits::default()
        };
        let mut wanted = wgpu::Features::TIMESTAMP_QUERY;
        wanted.set(wgpu::Features::MAPPABLE_PRIMARY_BUFFERS, budget.writes_to_host);
        let features = adapter.features() & wanted;
        let (device, queue) = ready(adapter.request_device(&wgpu::DeviceDescriptor {
            label: Some("vizflyt"),
            required_features: features,
            required_limits: limits,
            ..wgpu::DeviceDescriptor::default()
        }))
        .map_err(|error| error.to_string())?;
        let fault = Arc::new(OnceLock::new());
        let uncaptured = Arc::clone(&fault);
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
            // The first error is the cause; later ones are its consequences.
            let _ = uncaptured.set(error.to_string());
        }));
        let lost = Arc::clone(&fault);
        device.set_device_lost_callback(move |reason, message| {
            let _ = lost.set(format!("{reason:?}: {message}"));
        });
        let binding_bytes = best
            .max_storage_buffer_binding_size
            .min(best.max_buffer_size)
            .min(budget.binding_bytes)
            // Indices into words are 32 bits wide, so a binding is limited to slightly less than 4 GiB.
            .min(MAX_BINDING_BYTES);
        Ok(Device {
            device,
            queue,
            fault,
            binding_bytes,
            is_card: !self.name.is_software,
            has_timestamps: features.contains(wgpu::Features::TIMESTAMP_QUERY),
            maps_storage: features.contains(wgpu::Features::MAPPABLE_PRIMARY_BUFFERS),
        })
    }
}

/// Open device and its limits.
#[derive(Debug)]
pub(super) struct Device {
    pub(super) device: wgpu::Device,
    pub(super) queue: wgpu::Queue,
    fault: Arc<OnceLock<String>>,
    /// Maximum size of a buffer that a shader accesses. [byte]
    pub(super) binding_bytes: u64,
    pub(super) has_timestamps: bool,
    /// Whether it is a graphics card instead of a software renderer.
    pub(super) is_card: bool,
    /// Whether shaders can write to host memory.
    pub(super) maps_storage: bool,
}

impl Device {
    /// Returns the first error, if any; the device is then unusable.
    pub(super) fn fault(&self) -> Option<String> {
        self.fault.get().cloned()
    }

    /// Creates a buffer; its size is at least that of one element of any type.
    pub(super) fn buffer(
        &self,
        label: &str,
        bytes: u64,
        usage: wgpu::BufferUsages,
    ) -> wgpu::Buffer {
        self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some(label),
            size: bytes.max(512).next_multiple_of(16),
            usage,
            mapped_at_creation: false,
        })
    }

    /// Creates a buffer for data between passes.
    pub(super) fn storage(&self, label: &str, bytes: u64) -> wgpu::Buffer {
        self.buffer(label, bytes, wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST)
    }

    /// Creates a buffer that the host writes and shaders read.
    pub(super) fn uniform(&self, label: &str, contents: &[u8]) -> wgpu::Buffer {
        let usage = wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST;
        let buffer = self.buffer(label, contents.len() as u64, usage);
        self.queue.write_buffer(&buffer, 0, contents);
        buffer
    }

    /// Compiles one entry point of a shader.
    pub(super) fn kernel(&self, source: &str, entry: &str, constants: &[(&str, f64)]) -> Kernel {
        let source = wgpu::ShaderSource::Wgsl(source.into());
        let descriptor = wgpu::ShaderModuleDescriptor { label: Some(entry), source };
        let mut checks = wgpu::ShaderRuntimeChecks::checked();
        checks.force_loop_bounding = false;
        // SAFETY: only the counters are omitted that end infinite loops: all loops of these shaders end.
        let module = unsafe { self.device.create_shader_module_trusted(descriptor, checks) };
        let pipeline = self.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some(entry),
            layout: None,
            module: &module,
            entry_point: Some(entry),
            compilation_options: wgpu::PipelineCompilationOptions {
                constants,
                // Every kernel writes its workgroup memory before it reads it.
                zero_initialize_workgroup_memory: false,
            },
            cache: None,
        });
        Kernel { pipeline }
    }

    /// Binds complete buffers for a kernel.
    pub(super) fn bind(
        &self,
        kernel: &Kernel,
        buffers: &[(u32, &wgpu::Buffer)],
    ) -> wgpu::BindGroup {
        let slices: Vec<_> = buffers.iter().map(|&(binding, b)| (binding, b.slice(..))).collect();
        self.bind_group(kernel, 0, &slices)
    }

    /// Binds parts of buffers for a kernel's group.
    pub(super) fn bind_group(
        &self,
        kernel: &Kernel,
        group: u32,
        slices: &[(u32, Slice<'_>)],
    ) -> wgpu::BindGroup {
        let entries: Vec<_> = slices
            .iter()
            .map(|&(binding, slice)| {
                let (buffer, offset) = (slice.buffer(), slice.offset());
                let part = wgpu::BufferBinding { buffer, offset, size: NonZero::new(slice.size()) };
                wgpu::BindGroupEntry { binding, resource: wgpu::BindingResource::Buffer(part) }
            })
            .collect();
        self.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: None,
            layout: &kernel.pipeline.get_bind_group_layout(group),
            entries: &entries,
        })
    }
}

/// Range of a buffer.
pub(super) type Slice<'a> = wgpu::BufferSlice<'a>;

/// Compiled entry point.
#[derive(Debug)]
pub(super) struct Kernel {
    pipeline: wgpu::ComputePipeline,
}

/// Number of workgroups.
#[derive(Clone, Copy, Debug)]
pub(super) enum Groups<'a> {
    /// Known on the host: x, y.
    Known(u32, u32),
    /// Counted on the device: three words of a buffer, from this index on.
    Counted(&'a wgpu::Buffer, u32),
}

impl Groups<'_> {
    /// Returns one workgroup per tile; `GRID` of the shaders is the maximum along x.
    pub(super) fn of_tiles(tiles: u32) -> Self {
        const GRID: u32 = 32_768;
        Self::Known(tiles.min(GRID), tiles.div_ceil(GRID))
    }
}

impl Kernel {
    /// Adds a dispatch to a pass.
    pub(super) fn run(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        bindings: &wgpu::BindGroup,
        groups: Groups<'_>,
    ) {
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(0, bindings, &[]);
        match groups {
            Groups::Known(x, y) => pass.dispatch_workgroups(x, y, 1),
            Groups::Counted(buffer, word) => {
                pass.dispatch_workgroups_indirect(buffer, u64::from(word) * 4);
            }
        }
    }
}

/// Returns the output of a wgpu future; outside of browsers, these are ready at once.
fn ready<F: Future>(future: F) -> F::Output {
    let mut future = pin!(future);
    let mut context = Context::from_waker(Waker::noop());
    loop {
        if let Poll::Ready(output) = future.as_mut().poll(&mut context) {
            return output;
        }
        std::thread::yield_now();
    }
}

/// Maximum size of a binding: 4 GiB minus 64 KiB. [byte]
const MAX_BINDING_BYTES: u64 = (1 << 32) - (1 << 16);
