//! Blur metric of an image, independent of its content.
//!
//! F. Crete, T. Dolmiere, P. Ladret, M. Nicolas, "The blur effect: perception and estimation with a new no-reference
//! perceptual blur metric", SPIE 6492, 2007: a second blur removes much of the differences between neighbouring pixels
//! of a sharp image, but little of those of an image that is already blurred.

/// Returns the blur of an image of H x W grey levels, from 0 (sharp) to 1: the mean of both directions. A uniform image
/// has 1. The paper uses the maximum of both, which hides horizontal motion blur if the vertical one is larger anyway.
pub(super) fn blur(width: usize, height: usize, grey: &[u8]) -> f64 {
    assert_eq!(grey.len(), width * height, "an image of another size");
    // The mean over squares reduces noise, which differs from pixel to pixel, but keeps edges.
    let by = (width / FINE_PX).max(2);
    let (small_width, small_height) = (width / by, height / by);
    if small_width < 2 * REACH || small_height < 2 * REACH {
        return 1.0;
    }
    let mut small = Vec::with_capacity(small_width * small_height);
    let mut sums = vec![0u32; small_width];
    for rows in grey.chunks_exact(by * width).take(small_height) {
        sums.fill(0);
        for row in rows.chunks_exact(width) {
            for (sum, square) in sums.iter_mut().zip(row.chunks_exact(by)) {
                *sum += square.iter().map(|&value| u32::from(value)).sum::<u32>();
            }
        }
        small.extend(sums.iter().map(|&sum| sum as f32 / (by * by) as f32));
    }
    let across = along(small_width, small_height, |x, y| small[y * small_width + x]);
    let down = along(small_height, small_width, |y, x| small[y * small_width + x]);
    f64::midpoint(across, down)
}

/// Returns the blur along the first coordinate, of `lines` lines with `length` values each.
fn along(length: usize, lines: usize, at: impl Fn(usize, usize) -> f32) -> f64 {
    let (mut sharp, mut lost) = (0.0, 0.0);
    let mut line = vec![0.0; length];
    for number in 0..lines {
        for (x, value) in line.iter_mut().enumerate() {
            *value = at(x, number);
        }
        // Difference of two adjacent box means: value that enters minus value that leaves.
        let pairs = line.windows(2 * REACH + 2).map(|window| {
            let difference = (window[REACH + 1] - window[REACH]).abs();
            let blurred = (window[2 * REACH + 1] - window[0]).abs() / (2 * REACH + 1) as f32;
            (difference, (difference - blurred).max(0.0))
        });
        let (of_sharp, of_lost) =
            pairs.fold((0.0f32, 0.0f32), |(s, l), pair| (s + pair.0, l + pair.1));
        sharp += f64::from(of_sharp);
        lost += f64::from(of_lost);
    }
    if sharp > 0.0 { (sharp - lost) / sharp } else { 1.0 }
}

/// Radius of the box filter of nine pixels.
const REACH: usize = 4;
/// Approximate width to which images are reduced. [px]
const FINE_PX: usize = 480;

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: (usize, usize) = (320, 240);

    /// Returns squares of several sizes and greys with noise, with motion blur of this number of pixels.
    fn dragged(across: usize, down: usize) -> Vec<u8> {
        let (width, height) = SIZE;
        let grey = |x: usize, y: usize| -> f64 {
            let (u, v) = (x / 23 + 3 * (y / 17), y / 31 + 5 * (x / 41));
            (40 + (u * 89 + v * 57) % 160) as f64
        };
        let mut noise = 1u32;
        let mut image = Vec::new();
        for y in 0..height {
            for x in 0..width {
                noise = noise.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                let steps = across.max(down).max(1);
                let sum: f64 = (0..steps)
                    .map(|step| grey(x + across * step / steps, y + down * step / steps))
                    .sum();
                let noise = f64::from(noise >> 24) / 255.0 * 6.0 - 3.0;
                image.push((sum / steps as f64 + noise).clamp(0.0, 255.0) as u8);
            }
        }
        image
    }

    #[test]
    fn blur_increases_with_motion_in_each_direction() {
        let of = |across, down| blur(SIZE.0, SIZE.1, &dragged(across, down));
        for turn in [|n: usize| (n, 0), |n: usize| (0, n), |n: usize| (n, n)] {
            let blurs: Vec<f64> = [0, 4, 8, 16].map(|n| of(turn(n).0, turn(n).1)).to_vec();
            assert!(blurs.windows(2).all(|pair| pair[0] + 0.02 < pair[1]), "{blurs:?}");
        }
    }

    #[test]
    fn uniform_and_tiny_images_are_not_sharp() {
        assert_eq!(blur(64, 48, &[9; 64 * 48]), 1.0);
        assert_eq!(blur(3, 2, &[0, 255, 0, 255, 0, 255]), 1.0);
    }
}
