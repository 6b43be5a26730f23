//! Layout of the forest, and true shapes of its objects.
//!
//! At least [`BLOCKING_TREES`] trees block the straight line to the goal. The gap between any two other trees is at
//! least [`GAP_M`]. Start and goal are free.

use glam::{DVec2, DVec3};
use vizflyt_protocol::geometry::Volume;

use crate::random::{Rng, polar};

/// Species of a tree, which determines bark, leaves and shape.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Species {
    Pine,
    Beech,
    Birch,
}

/// Straight limb: a branch, root or log.
// Why: all fields are lengths or positions in metres.
#[expect(clippy::struct_field_names)]
#[derive(Clone, Copy, Debug)]
pub(crate) struct Limb {
    pub(crate) from_m: DVec3,
    pub(crate) to_m: DVec3,
    pub(crate) radius_m: f64,
}

/// Tree: axis and solids.
#[derive(Clone, Debug)]
pub(crate) struct Tree {
    pub(crate) species: Species,
    /// Points of the axis from below the ground to the top, with the radius at each. [m, world]
    pub(crate) axis: Vec<(DVec3, f64)>,
    pub(crate) roots: Vec<Limb>,
    pub(crate) branches: Vec<Limb>,
    /// Solids of trunk and roots.
    pub(crate) trunk: Vec<Volume>,
    /// Whether the tree is within the fence. If so, it is painted finely, and its branches are true solids.
    pub(crate) within: bool,
    /// Seed of the tree's noise.
    pub(crate) key: u64,
}

impl Tree {
    /// Returns the axis point and radius at a height, clamped to the ends. [m]
    pub(crate) fn at_height(&self, z_m: f64) -> (DVec3, f64) {
        for pair in self.axis.windows(2) {
            let ((a, radius_a), (b, radius_b)) = (pair[0], pair[1]);
            if z_m <= b.z {
                let t = ((z_m - a.z) / (b.z - a.z)).clamp(0.0, 1.0);
                return (a.lerp(b, t), radius_a + (radius_b - radius_a) * t);
            }
        }
        self.axis[self.axis.len() - 1]
    }

    /// Returns the height of the top. [m]
    pub(crate) fn top_m(&self) -> f64 {
        self.axis[self.axis.len() - 1].0.z
    }

    /// Returns the minimum gap between two trunks up to the flight height. [m]
    pub(crate) fn gap_m(&self, other: &Self) -> f64 {
        [0.5, 1.2, 2.0, 3.0]
            .into_iter()
            .map(|z_m| {
                let ((a, radius_a), (b, radius_b)) = (self.at_height(z_m), other.at_height(z_m));
                (a - b).truncate().length() - radius_a - radius_b
            })
            .fold(f64::MAX, f64::min)
    }
}

/// Boulder: a sphere that is partly in the ground.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Rock {
    pub(crate) center_m: DVec3,
    pub(crate) radius_m: f64,
}

/// Objects of the forest, and direction of the sun.
#[derive(Debug)]
pub(crate) struct Site {
    pub(crate) seed: u64,
    pub(crate) trees: Vec<Tree>,
    pub(crate) rocks: Vec<Rock>,
    pub(crate) logs: Vec<Limb>,
    /// Unit direction towards the sun. [world]
    pub(crate) sun: DVec3,
    pub(crate) goal_m: DVec3,
}

impl Site {
    /// Plans the forest of a seed.
    pub(crate) fn plan(seed: u64) -> Self {
        let mut rng = Rng::new(seed, 1);
        // The sun is on the left or right, high enough for streaks of light on the ground.
        let side = if rng.chance(0.5) { 1.0 } else { -1.0 };
        let azimuth_rad = side * rng.range(55f64.to_radians(), 100f64.to_radians());
        let elevation_rad = rng.range(34f64.to_radians(), 44f64.to_radians());
        let sun = (polar(azimuth_rad) * libm::cos(elevation_rad)).extend(libm::sin(elevation_rad));
        let goal_m = DVec3::new(GOAL_X_M, 0.0, FLIGHT_Z_M);
        let mut site =
            Self { seed, trees: Vec::new(), rocks: Vec::new(), logs: Vec::new(), sun, goal_m };
        site.block_the_straight_way(&mut rng);
        site.fill_the_arena(&mut rng);
        site.surround(&mut rng);
        site.lay_rocks_and_logs(&mut rng);
        site
    }

    /// Returns true obstacles and floor.
    pub(crate) fn truth(&self) -> Vec<Volume> {
        let mut volumes = vec![Volume::HalfSpace { normal: DVec3::Z, offset_m: 0.0 }];
        for tree in &self.trees {
            volumes.extend(&tree.trunk);
            if tree.within {
                volumes.extend(tree.branches.iter().map(capsule));
            }
        }
        volumes.extend(
            self.rocks
                .iter()
                .map(|rock| Volume::Sphere { center_m: rock.center_m, radius_m: rock.radius_m }),
        );
        volumes.extend(self.logs.iter().map(capsule));
        volumes
    }

    /// Whether a point of the floor is within `reach_m` of start or goal.
    pub(crate) fn is_near_ends(&self, p: DVec2, reach_m: f64) -> bool {
        [DVec2::new(SPAWN_X_M, 0.0), self.goal_m.truncate()]
            .iter()
            .any(|end| (p - *end).length() <= reach_m)
    }

    /// Whether an object with this radius is outside the free areas of start and goal.
    fn is_clear_of_ends(&self, p: DVec2, reach_m: f64) -> bool {
        !self.is_near_ends(p, CLEAR_M + reach_m)
    }

    fn block_the_straight_way(&mut self, rng: &mut Rng) {
        let count = BLOCKING_TREES + 1 + rng.below(2);
        let (first_m, last_m) = (5.5, GOAL_X_M - 4.0);
        let span_m = (last_m - first_m) / count as f64;
        for n in 0..count {
            let x = first_m + span_m * (n as f64 + rng.range(0.3, 0.7));
            let at = DVec2::new(x, rng.spread(0.17));
            let radius_m = slender_radius_m(rng).max(0.17);
            let tree = grow(rng, at, radius_m, true);
            self.trees.push(tree);
        }
    }

    fn fill_the_arena(&mut self, rng: &mut Rng) {
        let mut misses = 0;
        while self.trees.len() < TREES_WITHIN && misses < 4000 {
            let base = DVec2::new(rng.range(-0.4, 40.4), rng.spread(6.2));
            let radius_m = slender_radius_m(rng);
            let tree = grow(rng, base, radius_m, true);
            if self.is_clear_of_ends(base, 0.9)
                && self.trees.iter().all(|other| tree.gap_m(other) >= GAP_M)
            {
                self.trees.push(tree);
            } else {
                misses += 1;
            }
        }
    }

    fn surround(&mut self, rng: &mut Rng) {
        let mut misses = 0;
        let goal = TREES_WITHIN + TREES_AROUND;
        while self.trees.len() < goal && misses < 4000 {
            let base = DVec2::new(rng.range(-13.0, 54.0), rng.spread(17.0));
            let out_m = (base.y.abs() - FENCE_Y_M).max(-1.0 - base.x).max(base.x - 41.0);
            let radius_m = rng.range(0.12, 0.32);
            let tree = grow(rng, base, radius_m, false);
            // No tree leans over the fence below the crowns.
            if out_m > 0.9
                && self.is_clear_of_ends(base, 1.0)
                && self.trees.iter().all(|other| tree.gap_m(other) >= 1.1)
            {
                self.trees.push(tree);
            } else {
                misses += 1;
            }
        }
    }

    fn lay_rocks_and_logs(&mut self, rng: &mut Rng) {
        for _ in 0..60 {
            if self.rocks.len() >= 9 {
                break;
            }
            let radius_m = rng.range(0.22, 0.6);
            let p = DVec2::new(rng.range(3.0, 39.0), rng.spread(6.0));
            let center_m = p.extend(-radius_m * rng.range(0.25, 0.5));
            let apart = self.trees.iter().all(|tree| {
                (tree.at_height(0.2).0.truncate() - p).length() > radius_m + tree.axis[0].1 + 0.25
            });
            if self.is_clear_of_ends(p, radius_m) && apart {
                self.rocks.push(Rock { center_m, radius_m });
            }
        }
        for _ in 0..400 {
            if self.logs.len() >= 4 {
                break;
            }
            let radius_m = rng.range(0.09, 0.16);
            let middle = DVec2::new(rng.range(5.0, 35.0), rng.spread(5.5));
            let half = polar(rng.angle()) * rng.range(0.9, 1.8);
            let log = Limb {
                from_m: (middle - half).extend(radius_m * 0.75),
                to_m: (middle + half).extend(radius_m * 0.7),
                radius_m,
            };
            let apart = (0..=8).all(|n| {
                let p = log.from_m.lerp(log.to_m, f64::from(n) / 8.0);
                self.trees.iter().all(|tree| {
                    (tree.at_height(0.2).0 - p).truncate().length() > tree.axis[0].1 + 0.45
                }) && self
                    .rocks
                    .iter()
                    .all(|rock| (rock.center_m - p).length() > rock.radius_m + 0.3)
            });
            if self.is_clear_of_ends(middle, half.length() + radius_m) && apart {
                self.logs.push(log);
            }
        }
    }
}

/// Returns the solid of a limb.
pub(crate) fn capsule(limb: &Limb) -> Volume {
    Volume::Capsule { a_m: limb.from_m, b_m: limb.to_m, radius_m: limb.radius_m }
}

fn slender_radius_m(rng: &mut Rng) -> f64 {
    // Most trees are slender.
    let t = rng.unit();
    0.125 + 0.15 * t * t + rng.range(0.0, 0.03)
}

/// Generates a tree with the axis through `at` at flight height.
fn grow(rng: &mut Rng, at: DVec2, radius_m: f64, within: bool) -> Tree {
    let species = match rng.below(10) {
        0..=4 => Species::Pine,
        5..=7 => Species::Beech,
        _ => Species::Birch,
    };
    let top_m = rng.range(8.5, 11.5);
    let tilt = polar(rng.angle()) * rng.range(0.0, 0.045);
    let bend = polar(rng.angle()) * rng.range(0.02, 0.09);
    let phase = rng.angle();
    let point = |z: f64| {
        let above_m = z - FLIGHT_Z_M;
        let sway = libm::sin(0.8 * above_m + phase) - libm::sin(phase);
        (at + tilt * above_m + bend * sway).extend(z)
    };
    let base = point(0.0).truncate();
    let axis: Vec<(DVec3, f64)> = HEIGHTS_M
        .iter()
        .map(|&z| if z < 8.0 { z } else { top_m })
        .map(|z| (point(z), radius_m * (1.06 - 0.62 * (z / top_m).max(0.0))))
        .collect();
    let mut trunk: Vec<Volume> = axis
        .windows(2)
        .map(|pair| {
            let radius_m = f64::midpoint(pair[0].1, pair[1].1);
            Volume::Capsule { a_m: pair[0].0, b_m: pair[1].0, radius_m }
        })
        .collect();

    let mut roots = Vec::new();
    let turn = rng.angle();
    let count = 4 + rng.below(3);
    for n in 0..count {
        let out = polar(turn + core::f64::consts::TAU * n as f64 / count as f64 + rng.spread(0.3));
        let z_m = rng.range(0.12, 0.26);
        let from_m = point(z_m) + (out * radius_m * 0.62).extend(0.0);
        let to_m = (base + out * (radius_m + rng.range(0.14, 0.34))).extend(-rng.range(0.03, 0.06));
        roots.push(Limb { from_m, to_m, radius_m: radius_m * rng.range(0.26, 0.36) });
    }
    trunk.extend(roots.iter().map(capsule));

    let mut branches = Vec::new();
    let mut turn = rng.angle();
    let mut z_m = rng.range(CROWN_BASE_M + 0.2, CROWN_BASE_M + 0.65);
    while z_m < top_m - 0.6 {
        turn += 2.4 + rng.spread(0.5);
        let t = z_m / top_m;
        let reach_m = (1.0 - 0.62 * t) * rng.range(1.5, 2.7);
        let rise = match species {
            Species::Pine => rng.range(0.0, 0.25),
            Species::Beech => rng.range(0.25, 0.7),
            Species::Birch => rng.range(0.35, 0.9),
        };
        let from_m = point(z_m);
        let to_m = from_m + polar(turn).extend(rise) * reach_m;
        branches.push(Limb { from_m, to_m, radius_m: (radius_m * 0.24 * (1.2 - t)).max(0.02) });
        z_m += rng.range(0.55, 1.0);
    }
    Tree { species, axis, roots, branches, trunk, within, key: (rng.unit() * 1e9) as u64 }
}

/// Minimum number of trees that block the straight line from start to goal.
pub(crate) const BLOCKING_TREES: usize = 3;
/// Minimum gap between trunks within the fence. [m]
pub(crate) const GAP_M: f64 = 1.6;
/// Radius of the free areas around start and goal. [m]
pub(crate) const CLEAR_M: f64 = 2.5;
/// Start of the vehicle along x. [m, world]
pub(crate) const SPAWN_X_M: f64 = 1.0;
/// Goal along x. [m, world]
pub(crate) const GOAL_X_M: f64 = 37.5;
/// Takeoff height, and height of the goal. [m, world]
pub(crate) const FLIGHT_Z_M: f64 = 1.2;
/// Half width of the fence. [m, world]
pub(crate) const FENCE_Y_M: f64 = 7.0;

/// Minimum height of branches within the fence. [m, world]
const CROWN_BASE_M: f64 = 3.05;
const TREES_WITHIN: usize = 44;
const TREES_AROUND: usize = 92;
/// Heights of the axis points. Steps are short at flight height, so that the radius of the capsules is exact within a
/// centimetre. The last value stands for the top.
const HEIGHTS_M: [f64; 11] = [-0.4, 0.5, 1.0, 1.6, 2.3, 3.1, 4.0, 5.0, 6.2, 7.5, 9.0];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fifty_forests_meet_all_constraints() {
        for seed in 0..50 {
            let site = Site::plan(seed);
            let within: Vec<&Tree> = site.trees.iter().filter(|tree| tree.within).collect();
            assert!((34..=TREES_WITHIN).contains(&within.len()), "seed {seed}: {}", within.len());

            let start_m = DVec3::new(SPAWN_X_M, 0.0, FLIGHT_Z_M);
            let blocking = within
                .iter()
                .filter(|tree| {
                    // Trunks that intersect the line.
                    tree.trunk.iter().any(|part| {
                        (0..=4000).any(|n| {
                            let p_m = start_m.lerp(site.goal_m, f64::from(n) / 4000.0);
                            part.signed_distance_m(p_m) < 0.0
                        })
                    })
                })
                .count();
            assert!(blocking >= BLOCKING_TREES, "seed {seed}: {blocking} trees in the way");

            for (n, tree) in within.iter().enumerate() {
                for other in &within[..n] {
                    let gap_m = tree.gap_m(other);
                    assert!(gap_m >= GAP_M, "seed {seed}: a gap of {gap_m} m");
                }
            }
            for centre in [start_m, site.goal_m] {
                for volume in site.truth().iter().skip(1) {
                    // The free area is a cylinder from the floor up to the crowns.
                    for z_m in [0.0, 0.6, 1.2, 2.0, 2.9] {
                        let p_m = centre.truncate().extend(z_m);
                        let free_m = volume.signed_distance_m(p_m);
                        let wanted_m = CLEAR_M.min(CROWN_BASE_M - z_m);
                        assert!(free_m >= wanted_m, "seed {seed}: {volume:?} at {free_m} m");
                    }
                }
            }
        }
    }

    #[test]
    fn branches_are_above_the_flight_height() {
        for seed in 0..10 {
            for tree in Site::plan(seed).trees.iter().filter(|tree| tree.within) {
                for branch in &tree.branches {
                    let lowest_m = branch.from_m.z.min(branch.to_m.z) - branch.radius_m;
                    assert!(lowest_m >= 3.0, "seed {seed}: a branch at {lowest_m} m");
                }
            }
        }
    }

    #[test]
    fn capsules_follow_the_axis_within_a_centimetre() {
        for tree in Site::plan(3).trees.iter().filter(|tree| tree.within) {
            for n in 0..100 {
                let z_m = 0.6 + 0.024 * f64::from(n);
                let (p_m, radius_m) = tree.at_height(z_m);
                let inside = tree.trunk.iter().map(|part| -part.signed_distance_m(p_m));
                let thick_m = inside.fold(f64::MIN, f64::max);
                assert!((thick_m - radius_m).abs() < 0.015, "{thick_m} m thick, not {radius_m}");
            }
        }
    }
}
