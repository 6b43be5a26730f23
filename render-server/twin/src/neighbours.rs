//! Distances to the nearest neighbours, by a static k-d tree.

use glam::Vec3;
use rayon::prelude::*;

/// Returns the mean distance from each point to its three nearest neighbours; 0 for a single point.
pub(crate) fn spacing(points: &[Vec3]) -> Vec<f32> {
    let mut order: Vec<u32> = (0..points.len() as u32).collect();
    build(points, &mut order, 0);
    let mean = |i: usize| {
        // Squared distances in ascending order; the first is the point itself.
        let mut best = [f32::INFINITY; 4];
        search(points, &order, 0, points[i], &mut best);
        let known = best[1..].iter().filter(|d| d.is_finite());
        let count = known.clone().count().max(1);
        known.map(|d| d.sqrt()).sum::<f32>() / count as f32
    };
    (0..points.len()).into_par_iter().map(mean).collect()
}

/// Places the median of each range at its middle, cycling through the axes.
fn build(points: &[Vec3], order: &mut [u32], axis: usize) {
    if order.len() <= LEAF {
        return;
    }
    let middle = order.len() / 2;
    let key = |i: &u32| points[*i as usize][axis];
    order.select_nth_unstable_by(middle, |a, b| key(a).total_cmp(&key(b)));
    let (low, high) = order.split_at_mut(middle);
    build(points, low, (axis + 1) % 3);
    build(points, &mut high[1..], (axis + 1) % 3);
}

fn search(points: &[Vec3], order: &[u32], axis: usize, p: Vec3, best: &mut [f32; 4]) {
    let mut note = |i: u32| {
        let square = points[i as usize].distance_squared(p);
        if square < best[3] {
            best[3] = square;
            best.sort_unstable_by(f32::total_cmp);
        }
    };
    if order.len() <= LEAF {
        for &i in order {
            note(i);
        }
        return;
    }
    let middle = order.len() / 2;
    note(order[middle]);
    let off = p[axis] - points[order[middle] as usize][axis];
    let (low, high) = (&order[..middle], &order[middle + 1..]);
    let (near, far) = if off < 0.0 { (low, high) } else { (high, low) };
    search(points, near, (axis + 1) % 3, p, best);
    if off * off < best[3] {
        search(points, far, (axis + 1) % 3, p, best);
    }
}

const LEAF: usize = 8;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;

    #[test]
    fn spacing_equals_brute_force() {
        let mut random = Random::new(8);
        let mut point = || Vec3::new(random.unit(), random.unit() * 3.0, random.normal());
        let mut points: Vec<Vec3> = (0..500).map(|_| point()).collect();
        points.extend_from_within(..20);
        let found = spacing(&points);
        for (i, &p) in points.iter().enumerate() {
            let mut all: Vec<f32> =
                (0..points.len()).filter(|&j| j != i).map(|j| points[j].distance(p)).collect();
            all.sort_unstable_by(f32::total_cmp);
            let expected = (all[0] + all[1] + all[2]) / 3.0;
            assert!((found[i] - expected).abs() < 1e-6, "{} for {expected}", found[i]);
        }
        assert_eq!(spacing(&[Vec3::ONE]), [0.0]);
        assert!(spacing(&[]).is_empty());
    }
}
