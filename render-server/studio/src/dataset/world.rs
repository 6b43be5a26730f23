//! Scene for labelled rendering: its splats are divided into things, each of which is an object with an id.
//!
//! ```text
//! project, seed -> Generated, with its parts \
//!                                             > World: rest, things, gates, free space
//! arena or scene file, boxes of --parts -----/
//! ```
//! The renderer returns the object id of the visible splat of each pixel. Therefore, static things are cut out of the
//! scene and added as objects that never move. Their masks are exact, including occlusions.

use std::path::Path;

use anyhow::{Context, Result, ensure};
use glam::{DMat3, DQuat, DVec3};
use vizflyt_arena::Obstacles;
use vizflyt_arena::config::{ArenaConfig, StageConfig};
use vizflyt_arena::objects::MovingObjects;
use vizflyt_protocol::geometry::{Object, Pose, World as WorldFrame};
use vizflyt_scenes::projects::{CourseProject, Level};
use vizflyt_scenes::{Generated, Variant};
use vizflyt_server::scene::{self, BareArgs, PartsFile};
use vizflyt_splat::builtin_models::{QUADROTOR, boxes};
use vizflyt_splat::{RigidObject, Splats};
use vizflyt_twin::random::Random;

use super::classes::{self, Classes, GATE};
use super::free_space::{FreeSpace, Solid};
use super::randomize::{Randomize, range};
use super::{distractor, texture};

/// Scene with labels and free space.
#[derive(Debug)]
pub(super) struct World {
    /// Name, such as `p3-7`.
    pub(super) name: String,
    pub(super) seed: u64,
    pub(super) arena: ArenaConfig,
    /// Splats that belong to no thing. [m, world]
    pub(super) rest: Splats,
    /// Objects for the renderer; each has the id of its thing.
    pub(super) objects: Vec<RigidObject>,
    /// Placement rule of each object.
    pub(super) slots: Vec<Slot>,
    /// Things in order of their ids, from 1.
    pub(super) things: Vec<Thing>,
    pub(super) gates: Vec<Gate>,
    pub(super) movers: MovingObjects,
    pub(super) free: FreeSpace,
}

/// Labelled thing with an id.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Thing {
    pub(super) name: String,
    pub(super) class: u8,
}

/// Placement rule of an object.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Slot {
    /// At its place in the scene.
    Still,
    /// Shown if this gate (index among gates with textures) has this texture; 0 is the original one.
    Texture { gate: usize, texture: usize },
    /// Moves with the clock of the scene.
    Mover(usize),
    /// Placed randomly in each image, or absent. [m]
    Loose { distractor: bool, radius_m: f64 },
}

/// Opening to fly through.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Gate {
    pub(super) name: String,
    /// Id of its thing; 0 if no thing has its name.
    pub(super) id: u16,
    /// Pose of the opening's centre: x along the passage, y to the left, z up.
    pub(super) world_from_gate: Pose<WorldFrame, Object>,
    /// Width and height of the opening. [m]
    pub(super) size_m: [f64; 2],
}

impl Gate {
    fn of(stage: &StageConfig, things: &[Thing]) -> Self {
        // Same axes as the referee (`arena/course`): y is level; for a gate in the floor, its direction is arbitrary.
        let x = stage.normal.normalize_or(DVec3::X);
        let y = DVec3::Z.cross(x).normalize_or(DVec3::Y);
        let rotation = DQuat::from_mat3(&DMat3::from_cols(x, y, x.cross(y))).normalize();
        let named = things.iter().position(|thing| thing.name == stage.name);
        Self {
            name: stage.name.clone(),
            id: named.map_or(0, |index| index as u16 + 1),
            world_from_gate: Pose::new(stage.center_m, rotation),
            size_m: [stage.width_m, stage.height_m],
        }
    }

    /// Returns the corners as seen by an approaching vehicle: upper left, upper right, lower right, lower left.
    /// [m, world]
    pub(super) fn corners_m(&self) -> [DVec3; 4] {
        let [y, z] = self.size_m.map(|side| side / 2.0);
        [[y, z], [-y, z], [-y, -z], [y, -z]]
            .map(|[y, z]| self.world_from_gate.transform_point(DVec3::new(0.0, y, z)))
    }
}

/// Scene before it is divided into things.
struct Whole {
    name: String,
    seed: u64,
    arena: ArenaConfig,
    splats: Splats,
    /// Index of the thing of each splat.
    labels: Vec<Option<usize>>,
    things: Vec<Thing>,
    moving: Vec<RigidObject>,
    solid: Solid,
}

impl World {
    /// Generates the scene of a project for a seed.
    ///
    /// # Errors
    /// The parts are invalid.
    pub(super) fn generate(
        project: &CourseProject,
        seed: u64,
        how: &Randomize,
        parts: &PartsFile,
        classes: &Classes,
    ) -> Result<Self> {
        let Generated { splats, parts: ranges, arena, truth, objects, true_objects, .. } =
            project.generate(seed, Level::Ug, Variant::DAY);
        let mut labels = vec![None; splats.len()];
        let mut things = Vec::new();
        for part in ranges {
            labels[part.splats].fill(Some(things.len()));
            things.push(Thing { name: part.name, class: classes.of_part(part.class) });
        }
        let movers = MovingObjects::new(&arena, seed);
        let solid = Solid::True { still: truth, moving: true_objects, objects: movers };
        let name = format!("{}-{seed}", project.name());
        Self::cut(
            Whole { name, seed, arena, splats, labels, things, moving: objects, solid },
            how,
            parts,
            classes,
        )
    }

    /// Loads an arena or a scene file.
    ///
    /// # Errors
    /// A file cannot be read or used.
    pub(super) fn load(
        path: &Path,
        bare: &BareArgs,
        seed: u64,
        how: &Randomize,
        parts: &PartsFile,
        classes: &Classes,
    ) -> Result<Self> {
        let scene::Scene { arena, splats, objects, seen, .. } = scene::load(path, bare)?;
        let still = std::sync::Arc::new(scene::bake(&splats, &arena, seen.as_ref()));
        let obstacles: Obstacles = scene::obstacles(&arena, &objects, still, seed);
        let solid = Solid::Baked(obstacles);
        let labels = vec![None; splats.len()];
        let name = format!("scene-{seed}");
        let whole =
            Whole { name, seed, arena, splats, labels, things: Vec::new(), moving: objects, solid };
        Self::cut(whole, how, parts, classes)
    }

    fn cut(whole: Whole, how: &Randomize, parts: &PartsFile, classes: &Classes) -> Result<Self> {
        let Whole { name, seed, arena, splats, mut labels, mut things, moving, solid } = whole;
        let first_box = things.len();
        for (label, boxed) in labels.iter_mut().zip(parts.label(&splats)) {
            *label = boxed.map(|index| first_box + index).or(*label);
        }
        for part in &parts.parts {
            let class = classes.number(&part.class).context("a class of --parts is unknown")?;
            things.push(Thing { name: part.name.clone(), class });
        }
        let still = things.len();
        let mut cut = Cut { objects: Vec::new(), slots: Vec::new() };
        let mut random = Random::stream(seed, SCENE_STREAM);
        let mut textured = 0;
        let by_thing = indices(&labels, still);
        for (index, members) in by_thing.iter().enumerate() {
            let of_thing = taken(&splats, members);
            let id = index as u16 + 1;
            if things[index].class == GATE && how.textures() > 0 {
                let others: Vec<Splats> = (0..how.textures())
                    .map(|_| texture::retextured(&of_thing, &mut random))
                    .collect();
                for (texture, splats) in std::iter::once(of_thing).chain(others).enumerate() {
                    cut.push(id, splats, Slot::Texture { gate: textured, texture });
                }
                textured += 1;
            } else {
                cut.push(id, of_thing, Slot::Still);
            }
        }
        let rest = labels.iter().enumerate().filter(|(_, label)| label.is_none());
        let rest = taken(&splats, &rest.map(|(i, _)| i as u32).collect::<Vec<_>>());
        let quadrotor = boxes(&QUADROTOR);
        for (index, object) in moving.into_iter().enumerate() {
            let class = if object.splats == quadrotor { classes::VEHICLE } else { classes::MOVING };
            things.push(Thing { name: arena.objects[index].name.clone(), class });
            cut.push(things.len() as u16, object.splats, Slot::Mover(index));
        }
        for n in 0..how.distractors.count[1] {
            let size_m = range(&mut random, how.distractors.size_m);
            let splats = distractor::solid(size_m as f32 / 2.0, &mut random);
            let radius_m = radius_m(&splats);
            things
                .push(Thing { name: format!("distractor {}", n + 1), class: classes::DISTRACTOR });
            cut.push(things.len() as u16, splats, Slot::Loose { distractor: true, radius_m });
        }
        for n in 0..how.vehicles.count[1] {
            let radius_m = radius_m(&quadrotor);
            things.push(Thing { name: format!("vehicle {}", n + 1), class: classes::VEHICLE });
            let slot = Slot::Loose { distractor: false, radius_m };
            cut.push(things.len() as u16, quadrotor.clone(), slot);
        }
        ensure!(things.len() < usize::from(u16::MAX), "{} things are too many", things.len());
        let gates = arena.stages.iter().map(|stage| Gate::of(stage, &things[..still])).collect();
        let movers = match &solid {
            Solid::True { objects, .. } => objects.clone(),
            Solid::Baked(obstacles) => obstacles.objects.clone(),
        };
        let no_fly = arena.no_fly.iter().map(vizflyt_arena::config::NoFly::volume).collect();
        let free = FreeSpace { fence: arena.geofence, no_fly, solid };
        let Cut { objects, slots } = cut;
        Ok(Self { name, seed, arena, rest, objects, slots, things, gates, movers, free })
    }

    /// Returns the number of gates with random textures.
    pub(super) fn textured_gates(&self) -> usize {
        let of = |slot: &Slot| matches!(slot, Slot::Texture { texture: 0, .. });
        self.slots.iter().filter(|slot| of(slot)).count()
    }

    /// Returns the class of each id; [`classes::SCENE`] for id 0.
    pub(super) fn class_of_id(&self) -> Vec<u8> {
        let of_things = self.things.iter().map(|thing| thing.class);
        std::iter::once(classes::SCENE).chain(of_things).collect()
    }
}

#[derive(Default)]
struct Cut {
    objects: Vec<RigidObject>,
    slots: Vec<Slot>,
}

impl Cut {
    fn push(&mut self, id: u16, splats: Splats, slot: Slot) {
        self.objects.push(RigidObject { id, splats });
        self.slots.push(slot);
    }
}

/// Returns the indices of the splats of each label, in order.
fn indices(labels: &[Option<usize>], count: usize) -> Vec<Vec<u32>> {
    let mut found = vec![Vec::new(); count];
    for (i, label) in labels.iter().enumerate() {
        if let Some(label) = label {
            found[*label].push(i as u32);
        }
    }
    found
}

fn taken(splats: &Splats, members: &[u32]) -> Splats {
    let numbers = splats.sh_coefficients() * 3;
    let of = |i: &u32| *i as usize;
    Splats {
        means_m: members.iter().map(|i| splats.means_m[of(i)]).collect(),
        scales_m: members.iter().map(|i| splats.scales_m[of(i)]).collect(),
        rotations: members.iter().map(|i| splats.rotations[of(i)]).collect(),
        opacities: members.iter().map(|i| splats.opacities[of(i)]).collect(),
        sh: members
            .iter()
            .flat_map(|i| &splats.sh[of(i) * numbers..(of(i) + 1) * numbers])
            .copied()
            .collect(),
        ..Splats {
            sh_degree: splats.sh_degree,
            antialiased: splats.antialiased,
            ..Splats::default()
        }
    }
}

fn radius_m(splats: &Splats) -> f64 {
    f64::from(splats.means_m.iter().map(|p| p.length()).fold(0.0, f32::max))
}

/// Random stream for values drawn once per scene; streams of images count from 0.
const SCENE_STREAM: u64 = u64::MAX;

#[cfg(test)]
mod tests {
    use vizflyt_protocol::geometry::{Intrinsics, body_from_forward_cam};
    use vizflyt_splat::{Camera, CpuRenderer, Rasterizer, RgbdImage, Scene};

    use super::*;

    fn world(name: &str, how: &Randomize) -> World {
        let project = CourseProject::named(name).unwrap();
        let classes = Classes::with(std::iter::empty()).unwrap();
        World::generate(&project, 3, how, &PartsFile::default(), &classes).unwrap()
    }

    #[test]
    fn dividing_a_scene_does_not_change_its_images() {
        let cut = world("p5", &Randomize::default());
        let whole = CourseProject::named("p5").unwrap().generate(3, Level::Ug, Variant::DAY);
        // At an angle: patches of a wall seen from the front are equally far away, so that their order could change.
        let turn = DQuat::from_rotation_z(0.21) * DQuat::from_rotation_y(0.07);
        let pose: Pose<WorldFrame, vizflyt_protocol::geometry::Body> =
            Pose::new(DVec3::new(0.9, 0.2, 1.2), turn);
        let world_from_cam = pose * body_from_forward_cam(DVec3::ZERO, 0.0);
        let camera =
            Camera::new(Intrinsics::from_horizontal_fov(160, 120, 1.5), world_from_cam, 0.05);
        let at_ns = 1_000_000_000;
        let render = |scene: Scene<'_>, placements: &[vizflyt_splat::Placement]| {
            let mut images = [RgbdImage::default()];
            CpuRenderer::new(scene).render(placements, &[camera], &mut images).unwrap();
            let [image] = images;
            image
        };
        let before = render(
            Scene { splats: &whole.splats, objects: &whole.objects },
            &MovingObjects::new(&whole.arena, 3).placements(at_ns),
        );
        let placements: Vec<_> = cut
            .slots
            .iter()
            .map(|slot| match slot {
                Slot::Mover(index) => Some(cut.movers.placement(*index, at_ns)),
                _ => Some(Pose::IDENTITY),
            })
            .collect();
        let after = render(Scene { splats: &cut.rest, objects: &cut.objects }, &placements);
        let worst =
            before.rgb.iter().zip(&after.rgb).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(worst < 0.02, "{worst}");
        let gates =
            after.ids.iter().filter(|&&id| id != 0 && cut.class_of_id()[usize::from(id)] == GATE);
        assert!(gates.count() > 200);
    }

    #[test]
    fn finds_the_gates_of_all_stages() {
        let world = world("p5", &Randomize::default());
        let names: Vec<&str> = world.gates.iter().map(|gate| &*gate.name).collect();
        assert_eq!(names, ["window 1", "window 2", "gap", "clock hand"]);
        for (gate, stage) in world.gates.iter().zip(&world.arena.stages) {
            assert_eq!(world.things[usize::from(gate.id) - 1].name, gate.name);
            let [upper_left, upper_right, lower_right, _] = gate.corners_m();
            assert!(((upper_left - upper_right).length() - stage.width_m).abs() < 1e-9);
            assert!(upper_right.z - lower_right.z > 0.99 * stage.height_m);
            // The upper left corner is to the left of the passage.
            assert!(stage.normal.cross(upper_left - upper_right).z > 0.0);
        }
    }

    #[test]
    fn random_textures_and_objects_have_separate_slots() {
        let mut how = Randomize::default();
        how.gates.probability = 0.5;
        how.gates.textures = 3;
        how.distractors.count = [0, 4];
        how.vehicles.count = [1, 2];
        let world = world("p3", &how);
        assert_eq!(world.textured_gates(), 3);
        let textures = world.slots.iter().filter(|slot| matches!(slot, Slot::Texture { .. }));
        assert_eq!(textures.count(), 3 * 4);
        let loose = world.slots.iter().filter(|slot| matches!(slot, Slot::Loose { .. }));
        assert_eq!(loose.count(), 6);
        assert!(world.objects.iter().all(|object| usize::from(object.id) <= world.things.len()));
    }
}
