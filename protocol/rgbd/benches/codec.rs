//! Encode and decode at 320x240 and 640x480, with bits per pixel, beside RVL (Wilson, Fast
//! Lossless Depth Image Compression, ISS 2017), written here from the paper.
//!
//! `cargo bench -p vizflyt-rgbd`. One core; compare as ratios inside one run.

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use vizflyt_rgbd::depth::{DepthDecoder, DepthEncoder, scalar};
use vizflyt_rgbd::{Decoder, EncodeOptions, Encoder, RgbdView};

/// A deterministic stream of numbers.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u32 {
        self.0 = self.0.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (self.0 >> 33) as u32
    }
    fn below(&mut self, n: u32) -> u32 {
        self.next() % n
    }
}

/// A forest as a camera 1.2 m up sees it: ground, trunks nearer and nearer, leaf clumps, sky
/// without return; `noise_mm` on every valid pixel.
fn forest(width: usize, height: usize, noise_mm: u32) -> (Vec<u8>, Vec<u16>) {
    let mut random = Random(7);
    let (focal, horizon) = (width as f64 / 2.0, height as f64 / 2.0);
    let mut depth = vec![0u16; width * height];
    for (row, pixels) in depth.chunks_exact_mut(width).enumerate() {
        let below = row as f64 + 0.5 - horizon;
        if below > 0.0 {
            pixels.fill((1200.0 * focal / below).min(60000.0) as u16);
        }
    }
    for n in 0..60 {
        let distance_mm = 30000.0 / (1.0 + f64::from(n) * 0.25);
        let center = f64::from(random.below(width as u32));
        let half = (180.0 * focal / distance_mm).max(0.5);
        let foot = (horizon + 1200.0 * focal / distance_mm).min(height as f64);
        for y in 0..foot as usize {
            let (low, high) = ((center - half).max(0.0), (center + half).min(width as f64));
            for x in low as usize..high as usize {
                // A round trunk: nearest along its middle.
                let side = (x as f64 + 0.5 - center) / half;
                let round_mm = 180.0 * (1.0 - (1.0 - side * side).max(0.0).sqrt());
                depth[y * width + x] = (distance_mm + round_mm) as u16;
            }
        }
        for _ in 0..40 {
            let (x0, y0) =
                (random.below(width as u32) as i64, random.below(height as u32 / 2) as i64);
            let size = (60.0 * focal / distance_mm).max(1.0) as i64;
            let leaf_mm = distance_mm as u32 + random.below(400);
            for y in y0.max(0)..(y0 + size).min(height as i64) {
                for x in x0.max(0)..(x0 + size).min(width as i64) {
                    depth[y as usize * width + x as usize] = leaf_mm as u16;
                }
            }
        }
    }
    let mut rgb = Vec::with_capacity(3 * depth.len());
    for pixel in &mut depth {
        if *pixel > 0 && noise_mm > 0 {
            *pixel = (u32::from(*pixel) + random.below(2 * noise_mm + 1)).saturating_sub(noise_mm)
                as u16;
        }
        let shade = (*pixel as f64 / 6000.0).sin() * 80.0 + 120.0;
        for tint in [0.8, 1.0, 0.6] {
            rgb.push((shade * tint + f64::from(random.below(16))) as u8);
        }
    }
    (rgb, depth)
}

/// RVL: runs of zeros and of values by turns; differences to the last valid value, zig-zagged, in
/// variable-length groups of three bits and a continuation bit, eight groups a word.
mod rvl {
    #[derive(Default)]
    struct Nibbles {
        words: Vec<u32>,
        word: u32,
        filled: u32,
    }

    impl Nibbles {
        fn push(&mut self, mut value: u32) {
            loop {
                let more = value > 7;
                self.word = self.word << 4 | value & 7 | u32::from(more) << 3;
                value >>= 3;
                self.filled += 1;
                if self.filled == 8 {
                    self.words.push(self.word);
                    (self.word, self.filled) = (0, 0);
                }
                if !more {
                    return;
                }
            }
        }
    }

    pub(crate) fn encode(depth: &[u16]) -> Vec<u32> {
        let mut out = Nibbles { words: Vec::with_capacity(depth.len() / 2), ..Nibbles::default() };
        let (mut at, mut last) = (0, 0i32);
        while at < depth.len() {
            let zeros = depth[at..].iter().take_while(|&&pixel| pixel == 0).count();
            out.push(zeros as u32);
            at += zeros;
            let values = depth[at..].iter().take_while(|&&pixel| pixel != 0).count();
            out.push(values as u32);
            for &pixel in &depth[at..at + values] {
                let delta = i32::from(pixel) - last;
                out.push((delta << 1 ^ delta >> 31) as u32);
                last = i32::from(pixel);
            }
            at += values;
        }
        if out.filled > 0 {
            out.words.push(out.word << (4 * (8 - out.filled)));
        }
        out.words
    }

    pub(crate) fn decode(words: &[u32], depth: &mut [u16]) {
        let (mut at, mut word, mut left) = (0, 0u32, 0);
        let mut pop = || {
            let (mut value, mut shift) = (0, 0);
            loop {
                if left == 0 {
                    (word, left) = (words[at], 8);
                    at += 1;
                }
                let nibble = word >> 28;
                word <<= 4;
                left -= 1;
                value |= (nibble & 7) << shift;
                shift += 3;
                if nibble & 8 == 0 {
                    return value;
                }
            }
        };
        let (mut pixel, mut last) = (0, 0i32);
        while pixel < depth.len() {
            let zeros = pop() as usize;
            depth[pixel..pixel + zeros].fill(0);
            pixel += zeros;
            let values = pop() as usize;
            for out in &mut depth[pixel..pixel + values] {
                let code = pop();
                last += (code >> 1) as i32 ^ -((code & 1) as i32);
                *out = last as u16;
            }
            pixel += values;
        }
    }
}

fn depth_codecs(criterion: &mut Criterion) {
    for (width, height) in [(320, 240), (640, 480)] {
        for (scene, noise_mm) in [("forest", 0), ("noisy forest", 5)] {
            let (_, depth) = forest(width, height, noise_mm);
            let (mut bytes, mut out) = (Vec::new(), vec![0; depth.len()]);
            let (mut encoder, mut decoder) = (DepthEncoder::default(), DepthDecoder::default());
            encoder.encode(&depth, width, &mut bytes);
            let words = rvl::encode(&depth);
            rvl::decode(&words, &mut out);
            assert!(out == depth, "RVL is lossless");
            let bpp = |bytes: usize| bytes as f64 * 8.0 / depth.len() as f64;
            println!(
                "{scene} {width}x{height}: fast {:.2} bits a pixel, RVL {:.2}",
                bpp(bytes.len()),
                bpp(4 * words.len())
            );
            let mut group = criterion.benchmark_group(format!("{scene} depth {width}x{height}"));
            group.bench_function("fast encode", |bencher| {
                bencher.iter(|| {
                    bytes.clear();
                    encoder.encode(black_box(&depth), width, &mut bytes);
                });
            });
            group.bench_function("fast decode", |bencher| {
                bencher.iter(|| decoder.decode(black_box(&bytes), width, &mut out));
            });
            group.bench_function("RVL encode", |bencher| {
                bencher.iter(|| rvl::encode(black_box(&depth)));
            });
            group.bench_function("RVL decode", |bencher| {
                bencher.iter(|| rvl::decode(black_box(&words), &mut out));
            });
            if width == 320 && noise_mm == 0 {
                group.bench_function("reference decode", |bencher| {
                    bencher.iter(|| scalar::decode(black_box(&bytes), width, &mut out));
                });
            }
        }
    }
}

fn images(criterion: &mut Criterion) {
    for (width, height) in [(320, 240), (640, 480)] {
        let (rgb, depth_mm) = forest(width as usize, height as usize, 0);
        let view = RgbdView { width, height, rgb: &rgb, depth_mm: &depth_mm };
        let (mut encoder, mut decoder) = (Encoder::new(EncodeOptions::default()), Decoder::new());
        let mut bytes = Vec::new();
        encoder.encode(&view, &mut bytes).expect("a good image");
        let pixels = depth_mm.len();
        println!(
            "RGB-D {width}x{height}: {:.2} bits a pixel",
            bytes.len() as f64 * 8.0 / pixels as f64
        );
        let mut group = criterion.benchmark_group(format!("RGB-D {width}x{height}"));
        group.bench_function("encode", |bencher| {
            bencher.iter(|| encoder.encode(black_box(&view), &mut bytes));
        });
        let (mut rgb_out, mut depth_out) = (vec![0; 3 * pixels], vec![0; pixels]);
        group.bench_function("decode", |bencher| {
            bencher.iter(|| decoder.decode(black_box(&bytes), &mut rgb_out, &mut depth_out));
        });
    }
}

criterion_group! {
    name = benches;
    config = Criterion::default().sample_size(30).measurement_time(std::time::Duration::from_secs(2));
    targets = depth_codecs, images
}
criterion_main!(benches);
