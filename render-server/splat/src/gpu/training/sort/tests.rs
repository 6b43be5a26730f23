//! Tests of the sort only, repeated many times: a race appears as results that differ between runs.

use zerocopy::{FromBytes, IntoBytes};

use super::super::super::Budget;
use super::super::super::device::Adapter;
use super::super::{SLOTS, VISIBLE};
use super::*;

/// Buffers and kernels for sorting up to `capacity` pairs.
struct Bench {
    device: Device,
    sort: Sort,
    keys: [wgpu::Buffer; 2],
    values: [wgpu::Buffer; 2],
    counts: wgpu::Buffer,
    sizes: wgpu::Buffer,
    dispatches: wgpu::Buffer,
    staging: wgpu::Buffer,
}

impl Bench {
    fn new(capacity: usize) -> Option<Self> {
        let Some(adapter) = Adapter::all().into_iter().next() else {
            println!("skipped: no graphics adapter; install mesa-vulkan-drivers and libvulkan1");
            return None;
        };
        let device = adapter.open(&Budget::default()).expect("a device");
        let usage = wgpu::BufferUsages::STORAGE
            | wgpu::BufferUsages::COPY_DST
            | wgpu::BufferUsages::COPY_SRC
            | wgpu::BufferUsages::INDIRECT;
        let bytes = capacity as u64 * 4;
        let buffer = |bytes: u64| device.buffer("test", bytes, usage);
        let readable = wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST;
        Some(Self {
            sort: Sort::new(&device),
            keys: [buffer(bytes), buffer(bytes)],
            values: [buffer(bytes), buffer(bytes)],
            counts: buffer(count_bytes(capacity as u64)),
            sizes: buffer(32),
            dispatches: buffer(64),
            staging: device.buffer("staging", bytes * 2, readable),
            device,
        })
    }

    /// Sorts on the device by `bits` bits; returns keys and values. Values are the indices of the keys.
    fn sorted(&self, keys: &[u32], bits: u32, makes_values: bool) -> (Vec<u32>, Vec<u32>) {
        let Device { device, queue, .. } = &self.device;
        let kept = keys.iter().filter(|&&key| !makes_values || key != u32::MAX).count();
        let groups = |keys: usize| (keys as u64).div_ceil(SORT_GROUP) as u32;
        let mut sizes = [0u32; 8];
        sizes[SLOTS.size as usize] = keys.len() as u32;
        sizes[VISIBLE.size as usize] = kept as u32;
        let mut dispatches = [1u32; 16];
        dispatches[SLOTS.groups as usize] = groups(keys.len());
        dispatches[VISIBLE.groups as usize] = groups(kept);
        queue.write_buffer(&self.sizes, 0, sizes.as_bytes());
        queue.write_buffer(&self.dispatches, 0, dispatches.as_bytes());
        queue.write_buffer(&self.keys[0], 0, keys.as_bytes());
        if !makes_values {
            let indices: Vec<u32> = (0..keys.len() as u32).collect();
            queue.write_buffer(&self.values[0], 0, indices.as_bytes());
        }
        let pairs = Pairs {
            keys: [&self.keys[0], &self.keys[1]],
            values: [&self.values[0], &self.values[1]],
            counts: &self.counts,
            sizes: &self.sizes,
        };
        let bound = self.sort.bind(&self.device, pairs, bits, [SLOTS, VISIBLE], makes_values);
        let mut encoder = device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
        for digit in &bound {
            self.sort.run(&mut pass, digit, &self.dispatches);
        }
        drop(pass);
        let (result, bytes) = (bound.len() % 2, kept as u64 * 4);
        encoder.copy_buffer_to_buffer(&self.keys[result], 0, &self.staging, 0, bytes);
        encoder.copy_buffer_to_buffer(&self.values[result], 0, &self.staging, bytes, bytes);
        queue.submit([encoder.finish()]);
        self.staging.map_async(wgpu::MapMode::Read, .., |_| ());
        device.poll(wgpu::PollType::wait_indefinitely()).expect("the device");
        let view = self.staging.get_mapped_range(..).expect("a mapped buffer");
        let words = <[u32]>::ref_from_bytes(&view[..kept * 8]).expect("aligned");
        let (keys, values) = words.split_at(kept);
        let sorted = (keys.to_vec(), values.to_vec());
        drop(view);
        self.staging.unmap();
        assert_eq!(self.device.fault(), None);
        sorted
    }
}

/// Reference: stable sort of the standard library by the same bits.
fn expected(keys: &[u32], bits: u32, makes_values: bool) -> (Vec<u32>, Vec<u32>) {
    let kept = |&i: &u32| !makes_values || keys[i as usize] != u32::MAX;
    let mut order: Vec<u32> = (0..keys.len() as u32).filter(kept).collect();
    order.sort_by_key(|&i| u64::from(keys[i as usize]) % (1 << bits));
    (order.iter().map(|&i| keys[i as usize]).collect(), order)
}

fn random_keys(count: usize, seed: u64, mask: u32) -> Vec<u32> {
    let mut state = seed;
    let mut next = move || {
        // SplitMix64 (Steele, Lea, Flood 2014).
        state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (state ^ state >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        (z ^ z >> 31) as u32
    };
    (0..count).map(|_| next() & mask).collect()
}

#[test]
fn sorts_a_hundred_thousand_keys_a_hundred_times() {
    let Some(bench) = Bench::new(100_000) else { return };
    let keys = random_keys(100_000, 1, u32::MAX);
    let truth = expected(&keys, 32, true);
    for round in 0..100 {
        assert!(bench.sorted(&keys, 32, true) == truth, "round {round}");
    }
}

#[test]
fn sorts_a_million_keys_repeatedly() {
    let Some(bench) = Bench::new(1_000_000) else { return };
    // Depths from 0.2 m to 50 m in random order, and tiles with many equal keys, which must keep their order.
    let depths: Vec<u32> = random_keys(1_000_000, 2, u32::MAX)
        .into_iter()
        .map(|key| (0.2 + key as f32 / u32::MAX as f32 * 49.8).to_bits())
        .collect();
    let tiles = random_keys(1_000_000, 3, 1023);
    let (depth_truth, tile_truth) = (expected(&depths, 32, true), expected(&tiles, 16, false));
    for round in 0..5 {
        assert!(bench.sorted(&depths, 32, true) == depth_truth, "depths, round {round}");
        assert!(bench.sorted(&tiles, 16, false) == tile_truth, "tiles, round {round}");
    }
}

#[test]
fn sorts_every_count_and_pattern() {
    let Some(bench) = Bench::new(20_000) else { return };
    let check = |keys: &[u32], bits: u32, makes_values: bool| {
        let (count, truth) = (keys.len(), expected(keys, bits, makes_values));
        let first = keys.first();
        assert!(
            bench.sorted(keys, bits, makes_values) == truth,
            "{count} keys from {first:?}, {bits} bits, {makes_values}"
        );
    };
    // Around the sizes of subgroups, workgroups and groups.
    for count in [0, 1, 2, 7, 8, 31, 32, 33, 64, 128, 255, 256, 257, 2047, 2048, 2049, 20_000] {
        check(&random_keys(count, 4, u32::MAX), 32, true);
        check(&random_keys(count, 5, 0xff), 8, false);
    }
    let count = 10_000;
    check(&vec![7; count], 32, true);
    check(&vec![u32::MAX; count], 32, true);
    check(&(0..count as u32).collect::<Vec<_>>(), 32, true);
    check(&(0..count as u32).rev().collect::<Vec<_>>(), 24, false);
    // Half of the slots are empty, as in a block that is half in view.
    let mut sparse = random_keys(count, 6, u32::MAX >> 1);
    sparse.iter_mut().step_by(2).for_each(|key| *key = u32::MAX);
    check(&sparse, 32, true);
}
