use super::*;
use proptest::prelude::*;

#[track_caller]
fn check_round_trip(samples: &[u16], width: usize, kind: Samples) -> usize {
    let (mut encoder, mut decoder) = (PlaneEncoder::default(), PlaneDecoder::default());
    let mut bytes = Vec::new();
    encoder.encode(samples, width, kind, &mut bytes);
    let mut out = vec![1; samples.len()];
    let decoded = decoder.decode(&bytes, width, kind, &mut out);
    assert!(decoded.is_some(), "refused at {width}x{}", samples.len() / width);
    assert!(out == samples, "differs at {width}x{}", samples.len() / width);
    bytes.len()
}

#[test]
fn every_small_size_survives_a_round_trip() {
    let mut state = 1u32;
    for height in 1..=12 {
        for width in 1..=150 {
            let samples: Vec<u16> = (0..width * height)
                .map(|n: usize| {
                    state = state.wrapping_mul(1664525).wrapping_add(1013904223);
                    if n % 40 < 9 { 0 } else { (state >> 16) as u16 >> (n % 16) }
                })
                .collect();
            check_round_trip(&samples, width, Samples::Masked);
            let bytes: Vec<u16> = samples.iter().map(|sample| sample & 255).collect();
            check_round_trip(&bytes, width, Samples::Bytes);
        }
    }
}

#[test]
fn flat_planes_need_less_than_300_bytes() {
    for (value, kind) in [(255, Samples::Bytes), (0, Samples::Masked), (5000, Samples::Masked)] {
        let len = check_round_trip(&vec![value; 640 * 480], 640, kind);
        assert!(len < 300, "{len} bytes for a plane of {value}");
    }
}

#[test]
fn adversarial_contents_survive_a_round_trip() {
    for (width, height) in [(640, 480), (321, 243), (4096, 3), (1, 3000)] {
        let of = |pixel: &dyn Fn(usize, usize) -> u16| {
            let samples: Vec<u16> =
                (0..width * height).map(|n| pixel(n % width, n / width)).collect();
            check_round_trip(&samples, width, Samples::Masked);
        };
        of(&|x, y| if (x + y) % 2 == 0 { 0 } else { u16::MAX });
        of(&|x, y| if (x + y) % 2 == 0 { 1 } else { u16::MAX });
        of(&|x, _| (x * 40000) as u16);
        of(&|x, y| ((x * 7919) ^ (y * 104729)).wrapping_mul(2654435761) as u16);
    }
}

proptest! {
    #[test]
    fn does_not_panic_on_arbitrary_bytes(bytes in prop::collection::vec(any::<u8>(), 0..400), width in 1usize..80) {
        for kind in [Samples::Bytes, Samples::Masked] {
            let mut out = vec![0; width * 5];
            let _ = PlaneDecoder::default().decode(&bytes, width, kind, &mut out);
            if kind == Samples::Bytes {
                prop_assert!(out.iter().all(|&sample| sample < 256), "{out:?}");
            }
        }
    }

    /// Most changed bits are detected, and none causes a panic.
    #[test]
    fn does_not_panic_on_flipped_bits(seed: u32, at: prop::sample::Index, bit in 0u8..8) {
        let samples: Vec<u16> = (0..70 * 9).map(|n: u32| (n.wrapping_mul(seed) >> 20) as u16).collect();
        let mut bytes = Vec::new();
        PlaneEncoder::default().encode(&samples, 70, Samples::Masked, &mut bytes);
        let at = at.index(bytes.len());
        bytes[at] ^= 1 << bit;
        let mut out = vec![0; samples.len()];
        let _ = PlaneDecoder::default().decode(&bytes, 70, Samples::Masked, &mut out);
    }
}
