use super::{InstructionSet, Kernel, Simd};

/// Checks every operation of a set against plain f32 arithmetic, lane by lane.
struct Check;

impl Kernel for Check {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let values = |seed: f32| -> Vec<f32> {
            (0..16).map(|i| ((i as f32 + seed) * 12.9898).sin() * 7.0).collect()
        };
        let (a, b, c) = (values(1.0), values(2.0), values(3.0));
        let (va, vb, vc) = (s.load(&a), s.load(&b), s.load(&c));
        let check = |what: &str, v: S::F, expected: &dyn Fn(usize) -> f32, tolerance: f32| {
            let mut got = [0.0; 16];
            s.store(v, &mut got);
            for i in 0..S::LANES {
                let want = expected(i);
                let near = (got[i] - want).abs() <= tolerance * want.abs().max(1e-30);
                assert!(near, "{what} lane {i}: {} for {want}", got[i]);
            }
        };
        check("splat", s.splat(2.5), &|_| 2.5, 0.0);
        check("add", va + vb, &|i| a[i] + b[i], 0.0);
        check("sub", va - vb, &|i| a[i] - b[i], 0.0);
        check("mul", va * vb, &|i| a[i] * b[i], 0.0);
        check("div", va / vb, &|i| a[i] / b[i], 0.0);
        check("mul_add", s.mul_add(va, vb, vc), &|i| a[i].mul_add(b[i], c[i]), 1e-4);
        check("neg_mul_add", s.neg_mul_add(va, vb, vc), &|i| (-a[i]).mul_add(b[i], c[i]), 1e-4);
        check("min", s.min(va, vb), &|i| a[i].min(b[i]), 0.0);
        check("max", s.max(va, vb), &|i| a[i].max(b[i]), 0.0);
        check("sqrt", s.sqrt(va * va), &|i| (a[i] * a[i]).sqrt(), 1e-7);
        check("floor", s.floor(va), &|i| a[i].floor(), 0.0);
        check("exp2", s.exp2(va), &|i| a[i].exp2(), 4e-6);
        let above_2 = va * va + s.splat(2.0);
        check("log2", s.log2(above_2), &|i| (a[i] * a[i] + 2.0).log2(), 1e-6);
        let tiny = above_2 * s.splat(1e-20);
        check("log2 of little", s.log2(tiny), &|i| ((a[i] * a[i] + 2.0) * 1e-20).log2(), 1e-6);
        check("log2 of 0", s.log2(s.splat(0.0)), &|_| -127.0, 0.0);
        check("negative", s.negative(va), &|i| -a[i].abs(), 0.0);
        let sum: f32 = a[..S::LANES].iter().sum();
        assert!((s.sum(va) - sum).abs() < 1e-4, "sum: {} for {sum}", s.sum(va));
        check(
            "select",
            s.select(s.lt(va, vb), va, vc),
            &|i| if a[i] < b[i] { a[i] } else { c[i] },
            0.0,
        );
        check("keep", s.keep(s.lt(va, vb), va), &|i| if a[i] < b[i] { a[i] } else { 0.0 }, 0.0);

        let nan = s.splat(f32::NAN);
        check("min of NaN", s.min(nan, va), &|i| a[i], 0.0);
        check("max of NaN", s.max(nan, va), &|i| a[i], 0.0);
        assert!(!s.any(s.lt(nan, va)) && !s.any(s.lt(va, nan)), "NaN is less than nothing");

        let zero = s.splat(0.0);
        let expected = (0..S::LANES).fold(0, |bits, i| bits | u32::from(a[i] < 0.0) << i);
        assert_eq!(s.bits(s.lt(va, zero)), expected);
        let both = s.lt(va, zero) & s.lt(vb, zero);
        assert_eq!(s.any(both), (0..S::LANES).any(|i| a[i] < 0.0 && b[i] < 0.0));

        let bytes: [u8; 64] = std::array::from_fn(|i| (i * i * 37 + i) as u8);
        let planes = s.bit_planes(&bytes);
        for (i, byte) in bytes.iter().enumerate() {
            for (bit, plane) in planes.iter().enumerate() {
                assert_eq!(plane >> i & 1, u64::from(byte >> bit & 1), "byte {i}, bit {bit}");
            }
        }

        // All finite halves, including subnormal ones.
        for chunk in (0..=u16::MAX).collect::<Vec<_>>().chunks(16) {
            let finite: Vec<u16> =
                chunk.iter().map(|&h| if h & 0x7c00 == 0x7c00 { 0 } else { h }).collect();
            check(
                "load_f16",
                s.load_f16(&finite),
                &|i| half::f16::from_bits(finite[i]).to_f32(),
                0.0,
            );
        }
        s.prefetch(&a[0]);
    }
}

#[test]
fn every_set_matches_plain_arithmetic() {
    for set in InstructionSet::available() {
        match set {
            #[cfg(target_arch = "x86_64")]
            InstructionSet::Avx512(simd) => simd.run(Check),
            #[cfg(target_arch = "x86_64")]
            InstructionSet::Avx2(simd) => simd.run(Check),
            #[cfg(target_arch = "aarch64")]
            InstructionSet::Neon(simd) => simd.run(Check),
            InstructionSet::Portable(simd) => simd.run(Check),
        }
    }
}
