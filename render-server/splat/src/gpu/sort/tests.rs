//! Tests of the sort only: lists of every length, shorter than a run, of one run, and of several merged runs.

use zerocopy::{FromBytes as _, IntoBytes as _};

use super::super::Budget;
use super::super::device::Adapter;
use super::super::view::Tick;
use super::*;

/// Pair of depth as bits, and slot.
type Pair = [u32; 2];

/// Lengths around a run of 1024 pairs, and merged once to four times; a thread's strip has 16 pairs.
const LENGTHS: [usize; 24] = [
    0, 1, 2, 3, 4, 5, 7, 8, 255, 256, 257, 1000, 1023, 1024, 1025, 1040, 2047, 2048, 2049, 3000,
    4097, 5000, 8193, 9000,
];
/// Pairs between lists, which must not change.
const GAP: usize = 3;
const UNTOUCHED: Pair = [0xdead_beef; 2];

/// Sorts lists on the device, one tile each; returns `None` without an adapter.
fn sorted(lists: &[Vec<Pair>]) -> Option<Vec<Vec<Pair>>> {
    let Some(adapter) = Adapter::all().into_iter().next() else {
        println!("skipped: no graphics adapter; install mesa-vulkan-drivers and libvulkan1");
        return None;
    };
    let device = adapter.open(&Budget::default()).expect("a device");
    let sort = Sort::new(&device);
    let (mut pairs, mut firsts, mut ends) = (Vec::new(), Vec::new(), Vec::new());
    for list in lists {
        firsts.push(pairs.len() as u32);
        pairs.extend_from_slice(list);
        ends.push(pairs.len() as u32);
        pairs.extend([UNTOUCHED; GAP]);
    }
    let tick = Tick { tiles: lists.len() as u32, ..Tick::default() };
    let tick = device.uniform("tick", tick.as_bytes());
    let bytes = pairs.as_bytes().len() as u64;
    let usage =
        wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::COPY_SRC;
    let filled = |contents: &[u8]| {
        let buffer = device.buffer("test", contents.len() as u64, usage);
        device.queue.write_buffer(&buffer, 0, contents);
        buffer
    };
    let (ours, firsts, ends) =
        (filled(pairs.as_bytes()), filled(firsts.as_bytes()), filled(ends.as_bytes()));
    let other = device.storage("other", bytes);
    let bound =
        device.bind(&sort.kernel, &[(0, &tick), (1, &firsts), (2, &ends), (3, &ours), (4, &other)]);
    let readable = wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST;
    let staging = device.buffer("staging", bytes, readable);
    let mut encoder =
        device.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
    {
        let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
        sort.run(&mut pass, &bound, lists.len() as u32);
    }
    encoder.copy_buffer_to_buffer(&ours, 0, &staging, 0, bytes);
    let submission = device.queue.submit([encoder.finish()]);
    staging.map_async(wgpu::MapMode::Read, .., |_| ());
    let wait = wgpu::PollType::Wait { submission_index: Some(submission), timeout: None };
    device.device.poll(wait).expect("the device is done");
    assert_eq!(device.fault(), None);
    let view = staging.get_mapped_range(..).expect("mapped");
    let mut rest = <[Pair]>::ref_from_bytes(&view[..bytes as usize]).expect("aligned");
    let mut found = Vec::new();
    for list in lists {
        let (own, behind) = rest.split_at(list.len());
        assert_eq!(behind[..GAP], [UNTOUCHED; GAP], "behind a list of {}", list.len());
        found.push(own.to_vec());
        rest = &behind[GAP..];
    }
    Some(found)
}

#[test]
fn sorts_lists_of_every_length() {
    let mut state = 1u32;
    let mut random = move || {
        // Knuth's multiplier; only the upper bits are used.
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        state >> 8
    };
    let mut lists: Vec<Vec<Pair>> = Vec::new();
    for length in LENGTHS {
        // Slots are unique within a list, so no two pairs are equal.
        let mut slots: Vec<u32> = (0..length as u32).collect();
        for i in (1..length).rev() {
            slots.swap(i, random() as usize % (i + 1));
        }
        let list = |depth: &mut dyn FnMut(usize) -> u32| -> Vec<Pair> {
            slots.iter().enumerate().map(|(i, &slot)| [depth(i), slot]).collect()
        };
        lists.push(list(&mut |_| random() << 7));
        lists.push(list(&mut |_| random() % 5));
        lists.push(list(&mut |_| 0x3f80_0000));
        lists.push(list(&mut |i| i as u32));
        lists.push(list(&mut |i| (length - i) as u32));
    }
    let Some(found) = sorted(&lists) else { return };
    for (list, found) in lists.iter().zip(&found) {
        let mut expected = list.clone();
        expected.sort_unstable();
        assert!(*found == expected, "a list of {}", list.len());
    }
}
