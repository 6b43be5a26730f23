use super::*;
use proptest::prelude::*;

/// Checks that both encoders return the same bytes, and that both decoders return the original pixels.
#[track_caller]
fn check_round_trip(depth: &[u16], width: usize) -> usize {
    let (mut fast, mut reference) = (vec![7], vec![7]);
    DepthEncoder::default().encode(depth, width, &mut fast);
    scalar::encode(depth, width, &mut reference);
    assert!(fast == reference, "bytes differ at {width}x{}", depth.len() / width);
    let mut decoder = DepthDecoder::default();
    let mut out = vec![1; depth.len()];
    decoder.decode(&fast[1..], width, &mut out).unwrap();
    assert!(out == depth, "fast decoder differs at {width}x{}", depth.len() / width);
    out.fill(1);
    scalar::decode(&fast[1..], width, &mut out).unwrap();
    assert!(out == depth, "reference decoder differs at {width}x{}", depth.len() / width);
    fast.len() - 1
}

/// Deterministic pseudorandom numbers.
fn noise(seed: u64) -> impl FnMut() -> u16 {
    let mut state = seed.wrapping_mul(2).wrapping_add(1);
    move || {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 48) as u16
    }
}

#[test]
fn every_small_size_survives_a_round_trip() {
    for height in 1..=40 {
        for width in 1..=36 {
            let mut next = noise(height * 100 + width);
            let depth: Vec<u16> = (0..width * height).map(|_| next()).collect();
            check_round_trip(&depth, width as usize);
        }
    }
}

#[test]
fn adversarial_contents_survive_a_round_trip_at_usual_sizes() {
    for (width, height) in [(320, 240), (321, 243), (640, 480), (4096, 3), (1, 3000), (17, 257)] {
        let mut next = noise(1);
        let of = |pixel: &mut dyn FnMut(usize, usize) -> u16| {
            let image: Vec<u16> =
                (0..width * height).map(|n| pixel(n % width, n / width)).collect();
            check_round_trip(&image, width) as f64 * 8.0 / image.len() as f64
        };
        of(&mut |x, y| if (x + y) % 2 == 0 { 0 } else { u16::MAX });
        of(&mut |_, _| next());
        of(&mut |x, _| (x * 40000) as u16);
        let constant_bpp = of(&mut |_, _| 5000);
        if width > 16 {
            // One byte per block, and the bases.
            assert!(constant_bpp < 0.3, "{constant_bpp} bits a pixel for a constant image");
        }
    }
}

#[test]
fn encoder_and_decoder_can_be_reused_across_sizes() {
    let (mut encoder, mut decoder) = (DepthEncoder::default(), DepthDecoder::default());
    let mut next = noise(3);
    for (width, height) in [(64, 48), (5, 3), (100, 100), (1, 1), (64, 48)] {
        let depth: Vec<u16> = (0..width * height).map(|_| next()).collect();
        let mut bytes = Vec::new();
        encoder.encode(&depth, width, &mut bytes);
        let mut out = vec![0; depth.len()];
        decoder.decode(&bytes, width, &mut out).unwrap();
        assert_eq!(out, depth);
    }
}

#[test]
fn encoding_of_a_tiny_image_does_not_change() {
    // 2x1: the base is 3, so the residuals are 0 and 4, zig-zagged 0 and 8. There are no low bits, a mask with the
    // second of 64 residuals, and its four high bits.
    let mut bytes = Vec::new();
    DepthEncoder::default().encode(&[3, 7], 2, &mut bytes);
    let mut expected = vec![3, 0];
    expected.resize(16, 0);
    expected.extend([0x40, 2, 0, 0, 0, 0, 0, 0, 0, 8]);
    assert_eq!(bytes, expected);
}

#[test]
fn a_few_large_residuals_do_not_widen_a_block() {
    // One pixel of 64 differs by 12 bits: a mask, and high bits for its four neighbours.
    let mut depth = vec![1000; 64];
    depth[21] = 3000;
    assert!(check_round_trip(&depth, 16) <= 16 + 1 + 8 + 4 * 2);
}

proptest! {
    /// Piecewise smooth images with holes, as rendered.
    #[test]
    fn images_survive_a_round_trip(
        width in 1usize..90, height in 1usize..90, seed: u64,
        bits in 0u32..=16, hole in 0u16..=u16::MAX,
    ) {
        let mut next = noise(seed);
        let depth: Vec<u16> = (0..width * height)
            .map(|_| {
                let value = 1000u16.wrapping_add(next().checked_shr(16 - bits).unwrap_or(0));
                if next() < hole { 0 } else { value }
            })
            .collect();
        check_round_trip(&depth, width);
    }

    #[test]
    fn both_decoders_agree_on_arbitrary_bytes(
        width in 1usize..40, height in 1usize..40,
        bytes in prop::collection::vec(any::<u8>(), 0..3000),
    ) {
        let (mut a, mut b) = (vec![0; width * height], vec![0; width * height]);
        let fast = DepthDecoder::default().decode(&bytes, width, &mut a);
        let reference = scalar::decode(&bytes, width, &mut b);
        prop_assert_eq!(&fast, &reference);
        prop_assert!(fast.is_err() || a == b);
    }

    /// Damaged tables and bits with correct lengths: both decoders return the same pixels or the same error.
    #[test]
    fn both_decoders_agree_on_damaged_bytes(
        seed: u64, flips in prop::collection::vec((any::<prop::sample::Index>(), 0u8..8), 1..4),
    ) {
        let (width, height) = (37, 21);
        let mut next = noise(seed);
        let depth: Vec<u16> = (0..width * height).map(|_| next() >> 9).collect();
        let mut bytes = Vec::new();
        DepthEncoder::default().encode(&depth, width, &mut bytes);
        for (at, bit) in flips {
            let at = at.index(bytes.len());
            bytes[at] ^= 1 << bit;
        }
        let (mut a, mut b) = (vec![0; width * height], vec![0; width * height]);
        let fast = DepthDecoder::default().decode(&bytes, width, &mut a);
        prop_assert_eq!(&fast, &scalar::decode(&bytes, width, &mut b));
        prop_assert!(fast.is_err() || a == b);
    }
}
