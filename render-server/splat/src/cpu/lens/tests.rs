use glam::DVec2;
use vizflyt_protocol::geometry::{Distortion, Intrinsics, Pose};

use super::{Lenses, Model, atan, distort};
use crate::Camera;
use crate::cpu::simd::{InstructionSet, Kernel, Simd};

fn every_set<K: Kernel + Clone>(kernel: &K) {
    for set in InstructionSet::available() {
        match set {
            #[cfg(target_arch = "x86_64")]
            InstructionSet::Avx512(simd) => drop(simd.run(kernel.clone())),
            #[cfg(target_arch = "x86_64")]
            InstructionSet::Avx2(simd) => drop(simd.run(kernel.clone())),
            #[cfg(target_arch = "aarch64")]
            InstructionSet::Neon(simd) => drop(simd.run(kernel.clone())),
            InstructionSet::Portable(simd) => drop(simd.run(kernel.clone())),
        }
    }
}

/// Checks the arc tangent over all possible slopes.
#[derive(Clone)]
struct Atan;

impl Kernel for Atan {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let values: Vec<f32> = (0..16000).map(|i| 10f32.powf(i as f32 / 2000.0 - 6.0)).collect();
        for values in values.chunks_exact(16) {
            let v = s.load(values);
            let mut found = [0.0; 16];
            s.store(atan(s, v, s.splat(1.0) / v), &mut found);
            for (found, v) in found.iter().zip(values).take(S::LANES) {
                let error = f64::from(*found) - f64::from(*v).atan();
                assert!(error.abs() < 2e-7, "atan {v} is off by {error}");
            }
        }
    }
}

/// Compares a lens on vectors with the protocol's implementation; slopes up to the second field.
#[derive(Clone)]
struct Distort(Distortion, f64);

impl Kernel for Distort {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self(lens, longest) = self;
        let model = match lens {
            Distortion::None => Model::Pinhole,
            Distortion::BrownConrady { k1, k2, p1, p2, k3 } => {
                Model::BrownConrady([k1, k2, p1, p2, k3].map(|k| k as f32))
            }
            Distortion::KannalaBrandt { k1, k2, k3, k4 } => {
                Model::KannalaBrandt([k1, k2, k3, k4].map(|k| k as f32))
            }
        };
        for i in 0..200 {
            let (mut x, mut y) = ([0f32; 16], [0f32; 16]);
            for lane in 0..S::LANES {
                let n = f64::from(i * 16 + lane as u32);
                let slope = DVec2::from_angle(n * 2.4) * (longest * n / 3200.0);
                (x[lane], y[lane]) = (slope.x as f32, slope.y as f32);
            }
            let distorted = distort(s, &model, [s.load(&x), s.load(&y)]);
            let mut found = [[0f32; 16]; 5];
            for (out, v) in
                found.iter_mut().zip(distorted.slope.into_iter().chain(distorted.jacobian))
            {
                s.store(v, out);
            }
            for lane in 0..S::LANES {
                let at = DVec2::new(f64::from(x[lane]), f64::from(y[lane]));
                let (slope, jacobian) = lens.distort(at);
                let [xx, xy, yy] = [jacobian.x_axis.x, jacobian.x_axis.y, jacobian.y_axis.y];
                let want = [slope.x, slope.y, xx, xy, yy];
                for (found, want) in found.iter().zip(want) {
                    let error = f64::from(found[lane]) - want;
                    assert!(error.abs() < 1e-6 * want.abs().max(1.0), "{lens:?} at {at}: {error}");
                }
            }
        }
    }
}

#[test]
fn arc_tangent_is_exact_to_a_thousandth_of_a_pixel() {
    every_set(&Atan);
}

#[test]
fn vector_distortion_matches_the_protocol() {
    every_set(&Distort(Distortion::None, 50.0));
    let (k1, k2, k3) = (-0.21, 0.06, -0.004);
    every_set(&Distort(Distortion::BrownConrady { k1, k2, p1: 0.003, p2: -0.002, k3 }, 1.2));
    let (k1, k2, k3, k4) = (0.02, -0.006, 0.001, -0.0002);
    every_set(&Distort(Distortion::KannalaBrandt { k1, k2, k3, k4 }, 57.0));
}

#[test]
fn lens_cache_replaces_the_oldest() {
    let camera = |i: u32| {
        Camera::new(Intrinsics::from_horizontal_fov(64 + i, 48, 1.2), Pose::IDENTITY, 0.05)
    };
    let mut lenses = Lenses::default();
    for round in 0..3 {
        for i in 0..40 {
            let lens = lenses.of(&camera(i));
            assert_eq!(lens.of, camera(i).intrinsics, "round {round}");
            assert_eq!(lens.slopes, camera(i).slope_bounds());
        }
        assert_eq!(lenses.kept.len(), super::KEPT);
    }
}
