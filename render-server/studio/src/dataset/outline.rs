//! Outline of a mask as one polygon, as YOLO's segments require: around the pixels, with holes joined by seams.
//!
//! The boundary is followed with the mask on the right. A loop in the other direction is a hole. Each further loop is
//! joined to the polygon by the shortest seam, in both directions, so that the even-odd rule fills the mask.

/// Returns the polygon of a row-major mask, in corners of pixels; empty if no pixel is set. [px]
pub(super) fn outline(pixels: &[bool], size: [usize; 2]) -> Vec<[u32; 2]> {
    let mut loops = loops(pixels, size).into_iter();
    let Some(mut polygon) = loops.next() else { return Vec::new() };
    for hole in loops {
        join(&mut polygon, &hole);
    }
    polygon
}

/// Directions from a corner: right, down, left, up.
const STEPS: [[i32; 2]; 4] = [[1, 0], [0, 1], [-1, 0], [0, -1]];

/// Returns the boundary loops of the mask, the largest first.
fn loops(pixels: &[bool], [width, height]: [usize; 2]) -> Vec<Vec<[u32; 2]>> {
    let is_set = |x: i32, y: i32| {
        (0..width as i32).contains(&x)
            && (0..height as i32).contains(&y)
            && pixels[y as usize * width + x as usize]
    };
    // A boundary edge has a set pixel on its right and none on its left.
    let leaves = |x: i32, y: i32, direction: usize| {
        let [right, left] = match direction {
            0 => [[0, 0], [0, -1]],
            1 => [[-1, 0], [0, 0]],
            2 => [[-1, -1], [-1, 0]],
            _ => [[0, -1], [-1, -1]],
        };
        is_set(x + right[0], y + right[1]) && !is_set(x + left[0], y + left[1])
    };
    let at = |x: i32, y: i32| y as usize * (width + 1) + x as usize;
    let mut walked = vec![0u8; (width + 1) * (height + 1)];
    let mut found: Vec<Vec<[u32; 2]>> = Vec::new();
    for y in 0..height as i32 {
        for x in 0..width as i32 {
            if !leaves(x, y, 0) || walked[at(x, y)] & 1 != 0 {
                continue;
            }
            let (mut corner, mut direction) = ([x, y], 0);
            let mut corners = Vec::new();
            let mut before = 4;
            while walked[at(corner[0], corner[1])] >> direction & 1 == 0 {
                walked[at(corner[0], corner[1])] |= 1 << direction;
                if direction != before {
                    corners.push(corner.map(|side| side as u32));
                }
                before = direction;
                corner = [corner[0] + STEPS[direction][0], corner[1] + STEPS[direction][1]];
                // Right turns first, so that pixels that only touch at a corner are in separate loops.
                let turns = [1, 0, 3].map(|turn| (direction + turn) % 4);
                direction = turns
                    .into_iter()
                    .find(|&next| leaves(corner[0], corner[1], next))
                    .expect("a boundary of pixels is closed");
            }
            found.push(corners);
        }
    }
    // Sorted by their boxes, so that a hole comes after the loop around it.
    let reach = |corners: &[[u32; 2]]| {
        let side = |axis: usize| {
            let sides = corners.iter().map(|corner| corner[axis]);
            sides.clone().max().unwrap_or(0) - sides.min().unwrap_or(0)
        };
        u64::from(side(0)) * u64::from(side(1))
    };
    found.sort_by_key(|corners| std::cmp::Reverse(reach(corners)));
    found
}

/// Joins a loop to a polygon by the shortest seam between two corners.
fn join(polygon: &mut Vec<[u32; 2]>, hole: &[[u32; 2]]) {
    let distance2 = |a: [u32; 2], b: [u32; 2]| {
        let side = |axis: usize| u64::from(a[axis].abs_diff(b[axis])).pow(2);
        side(0) + side(1)
    };
    let pairs = (0..polygon.len()).flat_map(|a| (0..hole.len()).map(move |b| (a, b)));
    let Some((a, b)) = pairs.min_by_key(|&(a, b)| distance2(polygon[a], hole[b])) else { return };
    let around = hole[b..].iter().chain(&hole[..=b]).copied();
    let seam: Vec<[u32; 2]> = around.chain([polygon[a]]).collect();
    let after = polygon.split_off(a + 1);
    polygon.extend(seam.into_iter().chain(after));
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Whether the centre of a pixel is inside, by the even-odd rule.
    fn is_inside(polygon: &[[u32; 2]], x: usize, y: usize) -> bool {
        let (px, py) = (x as f64 + 0.5, y as f64 + 0.5);
        let mut inside = false;
        for (n, &a) in polygon.iter().enumerate() {
            let b = polygon[(n + 1) % polygon.len()];
            let ([ax, ay], [bx, by]) = (a.map(f64::from), b.map(f64::from));
            if (ay > py) != (by > py) && px < ax + (py - ay) / (by - ay) * (bx - ax) {
                inside = !inside;
            }
        }
        inside
    }

    #[test]
    fn joins_the_hole_of_a_frame_to_one_polygon() {
        let set = |k: usize| {
            let (x, y) = (k % 6, k / 6);
            (1..5).contains(&x)
                && (1..5).contains(&y)
                && !((2..4).contains(&x) && (2..4).contains(&y))
        };
        let pixels: Vec<bool> = (0..36).map(set).collect();
        let polygon = outline(&pixels, [6, 6]);
        // Four corners of each loop, plus both ends of the seam.
        assert_eq!(polygon.len(), 10);
        assert!((0..36).all(|k| is_inside(&polygon, k % 6, k / 6) == pixels[k]));
    }

    proptest! {
        #[test]
        fn the_outline_fills_the_mask(
            size in (1usize..9, 1usize..9),
            seed in prop::collection::vec(any::<bool>(), 64),
        ) {
            let size = [size.0, size.1];
            let pixels = &seed[..size[0] * size[1]];
            let polygon = outline(pixels, size);
            prop_assert_eq!(polygon.is_empty(), !pixels.contains(&true));
            for (k, &set) in pixels.iter().enumerate() {
                prop_assert_eq!(is_inside(&polygon, k % size[0], k / size[0]), set);
            }
        }
    }
}
