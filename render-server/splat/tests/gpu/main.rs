//! Compares the GPU renderer with the CPU renderer, on any available adapter; software Vulkan (`mesa-vulkan-drivers`)
//! is sufficient. Without an adapter, tests print what they skip.
#![cfg(feature = "gpu")]

mod agreement;
#[path = "../../benches/detail/city.rs"]
mod city;
#[allow(dead_code, reason = "the oracle's tests use more of it")]
#[path = "../images/compare.rs"]
mod compare;
mod detail;
mod limits;
mod poison;
mod twins;

use std::sync::OnceLock;

use vizflyt_splat::gpu::{Adapter, Budget, GpuRenderer};
use vizflyt_splat::{CpuRenderer, Placement, Rasterizer, RgbdImage, Scene};

/// Returns the adapter to test on.
fn adapter() -> Option<&'static Adapter> {
    static ADAPTERS: OnceLock<Vec<Adapter>> = OnceLock::new();
    let adapter = ADAPTERS.get_or_init(Adapter::all).first();
    if adapter.is_none() {
        println!("skipped: no graphics adapter; install mesa-vulkan-drivers and libvulkan1");
    }
    adapter
}

/// Returns a renderer with the default budget.
fn renderer<'a>(scene: impl Into<Scene<'a>>) -> Option<GpuRenderer> {
    Some(GpuRenderer::new(scene, adapter()?, Budget::default()).expect("a device"))
}

/// Renders with both renderers: (processor, graphics).
fn both<'a>(
    scene: impl Into<Scene<'a>>,
    placements: &[Placement],
    cameras: &[vizflyt_splat::Camera],
) -> Option<(Vec<RgbdImage>, Vec<RgbdImage>)> {
    let scene = scene.into();
    let mut gpu = renderer(scene)?;
    let mut cpu = CpuRenderer::new(scene);
    let mut expected = vec![RgbdImage::default(); cameras.len()];
    let mut actual = expected.clone();
    cpu.render(placements, cameras, &mut expected).expect("valid cameras");
    let times = gpu.render(placements, cameras, &mut actual).expect("valid cameras");
    assert!(times.total_ms >= times.read_ms && times.total_ms > 0.0, "{times:?}");
    assert_eq!(gpu.workload().splats, cpu.workload().splats);
    actual.iter().for_each(compare::assert_clean);
    Some((expected, actual))
}
