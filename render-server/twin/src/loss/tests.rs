//! Compares derivatives of the loss with finite differences.

use super::*;
use crate::random::Random;

const WIDTH: usize = 21;
const HEIGHT: usize = 18;

fn image(random: &mut Random) -> Planes {
    let mut image = Planes::default();
    image.resize(channel::COUNT, WIDTH, HEIGHT);
    for y in 0..HEIGHT {
        for x in 0..WIDTH {
            let through = random.within(0.0, 0.6);
            let (z, spread) = (random.within(1.0, 4.0), random.within(0.0, 0.3));
            let alpha = 1.0 - through;
            for c in 0..3 {
                *image.at_mut(c, x, y) = alpha * random.unit();
            }
            *image.at_mut(channel::FIRST, x, y) = alpha * z;
            *image.at_mut(channel::SECOND, x, y) = alpha * (z * z + spread);
            *image.at_mut(channel::TRANSMITTANCE, x, y) = through;
        }
    }
    image
}

fn target(random: &mut Random) -> Target {
    let pixels = WIDTH * HEIGHT;
    Target {
        width: WIDTH,
        height: HEIGHT,
        rgb: (0..3 * pixels).map(|_| random.below(256) as u8).collect(),
        mask: (0..pixels).map(|_| u8::from(random.unit() > 0.2)).collect(),
        points: (0..9)
            .map(|_| SeenPoint { pixel: random.below(pixels) as u32, z: random.within(1.0, 4.0) })
            .collect(),
        depth: (0..pixels)
            .map(|i| if i % 3 == 0 { random.within(1.0, 4.0) } else { 0.0 })
            .collect(),
    }
}

const WEIGHTS: Weights = Weights { dssim: 0.3, depth: 0.4, spread: 0.0, bend: 0.0 };
const BACKGROUND: [f32; 3] = [0.2, 0.9, 0.5];
const EXPOSURE: Exposure = Exposure { gain: [1.1, 0.8, 0.95], offset: [0.05, -0.02, 0.1] };

fn total(image: &Planes, target: &Target, exposure: &Exposure) -> f64 {
    let mut loss = Loss::default();
    loss.of(image, target, exposure, BACKGROUND, &WEIGHTS).0.total(&WEIGHTS)
}

#[test]
fn derivatives_match_finite_differences() {
    let mut random = Random::new(12);
    let (mut image, target) = (image(&mut random), target(&mut random));
    // Points may be on pixels with or without depth, masked or not: both terms of one pixel add up.
    let mut loss = Loss::default();
    let (_, by_exposure, by) = loss.of(&image, &target, &EXPOSURE, BACKGROUND, &WEIGHTS);
    let by = by.clone();
    let (mut worst, mut bent) = (0.0f64, 0);
    for channel in [0, 1, 2, channel::FIRST, channel::TRANSMITTANCE] {
        for i in (0..WIDTH * HEIGHT).step_by(2) {
            let (x, y) = (i % WIDTH, i / WIDTH);
            let here = image.at(channel, x, y);
            let step = 2e-3;
            *image.at_mut(channel, x, y) = here + step;
            let above = total(&image, &target, &EXPOSURE);
            *image.at_mut(channel, x, y) = here - step;
            let below = total(&image, &target, &EXPOSURE);
            *image.at_mut(channel, x, y) = here;
            let want = (above - below) / f64::from(2.0 * step);
            let got = f64::from(by.at(channel, x, y));
            let off = (want - got).abs();
            // The kink of an absolute value may be between the two samples.
            if off > 2e-5 + 0.02 * want.abs() {
                bent += 1;
            } else {
                worst = worst.max(off);
            }
        }
    }
    assert!(bent <= 15, "{bent} derivatives are off");
    for c in 0..3 {
        for (got, change) in
            [(by_exposure.gain[c], [1.0, 0.0]), (by_exposure.offset[c], [0.0, 1.0])]
        {
            let at = |step: f32| {
                let mut exposure = EXPOSURE;
                exposure.gain[c] += step * change[0];
                exposure.offset[c] += step * change[1];
                total(&image, &target, &exposure)
            };
            let want = (at(1e-3) - at(-1e-3)) / 2e-3;
            assert!((want - f64::from(got)).abs() < 2e-2 * (want.abs() + 0.02), "{got} for {want}");
        }
    }
}

#[test]
fn spread_is_minimal_at_a_single_depth() {
    // The mean is held constant, so the derivative is that of the variance about a fixed depth.
    let ray = Ray { alpha: 0.8, mean: 2.0, square: 4.0 };
    assert!(ray.spread() < 1e-6);
    let [first, second, through] = ray.by_spread();
    // A weight at depth z adds (z - D)^2 / D^2: zero at D, positive in front of and behind it.
    let of = |z: f32| first * z + second * z * z - through;
    assert!(of(2.0).abs() < 1e-6);
    assert!((of(1.0) - 0.25).abs() < 1e-6 && (of(3.0) - 0.25).abs() < 1e-6);
}

#[test]
fn identical_images_have_zero_loss() {
    let mut random = Random::new(1);
    let mut image = image(&mut random);
    let mut target = target(&mut random);
    for y in 0..HEIGHT {
        for x in 0..WIDTH {
            *image.at_mut(channel::TRANSMITTANCE, x, y) = 0.0;
            for c in 0..3 {
                *image.at_mut(c, x, y) = f32::from(target.rgb[3 * (y * WIDTH + x) + c]) / 255.0;
            }
        }
    }
    target.points.clear();
    target.depth.clear();
    let mut loss = Loss::default();
    let exposure = Exposure::default();
    let (parts, ..) = loss.of(&image, &target, &exposure, [0.0; 3], &WEIGHTS);
    assert!(parts.l1 < 1e-9 && (parts.ssim - 1.0).abs() < 1e-5, "{parts:?}");
    assert!(loss.quality(&image, &target, &exposure).0 > 90.0);
}

#[test]
fn smoothness_matches_finite_differences_and_is_zero_for_planes() {
    let mut random = Random::new(5);
    let (mut image, truth) = (image(&mut random), {
        let mut truth = Planes::default();
        truth.resize(3, WIDTH, HEIGHT);
        truth
    });
    let of = |image: &Planes| {
        let (mut scratch, mut by) = (smooth::Scratch::default(), Planes::default());
        by.resize(channel::BY_COUNT, WIDTH, HEIGHT);
        let bend = smooth::add(image, &truth, 1.0, &mut scratch, &mut by);
        (bend, by)
    };
    let (_, by) = of(&image);
    let mean = |image: &Planes| {
        let inverse = |i: usize| {
            let (x, y) = (i % WIDTH, i / WIDTH);
            (1.0 - image.at(channel::TRANSMITTANCE, x, y)) / image.at(channel::FIRST, x, y)
        };
        (0..WIDTH * HEIGHT).map(inverse).sum::<f32>()
    };
    for i in (0..WIDTH * HEIGHT).step_by(7) {
        let (x, y) = (i % WIDTH, i / WIDTH);
        for channel in [channel::FIRST, channel::TRANSMITTANCE] {
            let here = image.at(channel, x, y);
            // The derivative holds the mean inverse depth (the unit of the penalty) constant.
            let whole = mean(&image);
            let mut at = |value: f32| {
                *image.at_mut(channel, x, y) = value;
                of(&image).0 * f64::from(mean(&image) / whole)
            };
            let want = (at(here + 2e-3) - at(here - 2e-3)) / 4e-3;
            at(here);
            let got = f64::from(by.at(channel, x, y));
            assert!((want - got).abs() < 0.03 * want.abs() + 1.5e-4, "{got} for {want}");
        }
    }
    for y in 0..HEIGHT {
        for x in 0..WIDTH {
            let inverse = 0.2 + 0.01 * x as f32 + 0.02 * y as f32;
            *image.at_mut(channel::TRANSMITTANCE, x, y) = 0.0;
            *image.at_mut(channel::FIRST, x, y) = 1.0 / inverse;
        }
    }
    assert!(of(&image).0 < 1e-6);
}
