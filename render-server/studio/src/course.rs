//! The course that is flown for a grade: an instance of a project, generated from a seed.

use std::sync::Arc;

use anyhow::{Context, Result};
use glam::{Quat, Vec3};
use sha2::{Digest, Sha256};
use vizflyt_arena::config::EnvironmentConfig;
use vizflyt_arena::{ArenaConfig, BakeSpec, DistanceField, Obstacles};
use vizflyt_scenes::Variant;
use vizflyt_scenes::projects::{CourseProject, Level};
use vizflyt_server::render::sensors::SensorSet;
use vizflyt_server::scene::{bake_with, obstacles};
use vizflyt_splat::{RigidObject, Splats};
use vizflyt_trust::hex;

/// A course to fly, in memory. It is nowhere but in this process's memory.
pub struct CourseInstance {
    /// The room and its rules.
    pub arena: ArenaConfig,
    /// What cameras see. [m, world]
    pub splats: Splats,
    /// What moves in it. [m, object]
    pub objects: Vec<RigidObject>,
    /// What stands still, as the referee judges by it.
    pub field: Arc<DistanceField>,
    /// That, and what moves; its clock is 0 at the start of a flight.
    pub obstacles: Obstacles,
    /// The map that plugins may know, as JSON, where it is known.
    pub map: Option<String>,
    /// SHA-256 of what cameras see.
    pub scene_sha256: String,
    /// SHA-256 of the rules: the project's file and the arena's.
    pub rules_sha256: String,
}

/// Returns a project's name as grades have it. One from a file bears what it says, too: it is another project when it was
/// changed, and never one of the program's that its file is called after.
pub fn graded_name(project: &CourseProject) -> String {
    let name = project.name();
    if !project.is_from_file() {
        return name.to_owned();
    }
    let hash = hex(&Sha256::digest(project.text()));
    format!("{name}-{}", &hash[..16])
}

impl CourseInstance {
    /// Generates the course of a seed.
    ///
    /// # Errors
    /// If a sensor's model is none, or its arena cannot be written down: a test of the program's own projects excludes both.
    pub fn make(
        project: &CourseProject,
        level: Level,
        variant: Variant,
        seed: u64,
    ) -> Result<Self> {
        let generated = project.generate(seed, level, variant);
        SensorSet::new(&generated.arena.sensors).context("the course's sensors")?;
        // Not kept for later: on disk it would be a map for the next plugin.
        let baked =
            bake_with(&generated.splats, &BakeSpec::of(&generated.arena), None, None, &|_| ());
        // Light and fog belong to what cameras see.
        let environment = generated.arena.environment;
        let rules =
            ArenaConfig { environment: EnvironmentConfig::default(), ..generated.arena.clone() };
        let rules = rules.to_toml().context("the arena cannot be written down")?;
        let mut hash = Sha256::new();
        hash.update(project.text());
        hash.update([0]);
        hash.update(rules);
        let field = Arc::new(baked.field);
        let truth = Some(&generated.truth).filter(|_| generated.map_is_known);
        let map = truth.map(serde_json::to_string).transpose().context("the map has no text")?;
        let obstacles = obstacles(&generated.arena, &generated.objects, field.clone(), seed);
        Ok(Self {
            scene_sha256: hash_of(&generated.splats, &generated.objects, &environment)?,
            rules_sha256: hex(&hash.finalize()),
            arena: generated.arena,
            splats: generated.splats,
            objects: generated.objects,
            map,
            field,
            obstacles,
        })
    }
}

fn hash_of(
    splats: &Splats,
    objects: &[RigidObject],
    environment: &EnvironmentConfig,
) -> Result<String> {
    let mut hash = Sha256::new();
    take_all(&mut hash, splats);
    for object in objects {
        take_all(&mut hash, &object.splats);
    }
    let EnvironmentConfig { light, fog_visibility_m, fog, .. } = environment;
    for number in light.iter().chain(fog).chain([fog_visibility_m]) {
        hash.update(number.to_le_bytes());
    }
    if *environment
        != (EnvironmentConfig {
            light: *light,
            fog: *fog,
            fog_visibility_m: *fog_visibility_m,
            ..EnvironmentConfig::CLEAR
        })
    {
        // Numbers as people read them: the same text is the same weather.
        hash.update(serde_json::to_string(environment).context("weather has no text")?);
    }
    Ok(hex(&hash.finalize()))
}

fn take_all(hash: &mut Sha256, splats: &Splats) {
    let mut bytes = Vec::with_capacity(4 << 14);
    let mut take = |values: &mut dyn Iterator<Item = f32>| {
        for value in values {
            bytes.extend_from_slice(&value.to_le_bytes());
            if bytes.len() >= 4 << 14 {
                hash.update(&bytes);
                bytes.clear();
            }
        }
    };
    take(&mut std::iter::once(splats.len() as f32));
    take(&mut splats.means_m.iter().flat_map(Vec3::to_array));
    take(&mut splats.scales_m.iter().flat_map(Vec3::to_array));
    take(&mut splats.rotations.iter().flat_map(Quat::to_array));
    take(&mut splats.opacities.iter().copied());
    take(&mut splats.sh.iter().copied());
    hash.update(&bytes);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_never_one_of_the_programs_projects() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("p4.toml");
        let found = |text: &str| {
            std::fs::write(&path, text).unwrap();
            CourseProject::find(path.to_str().unwrap()).unwrap()
        };
        let p4 = CourseProject::named("p4").unwrap();
        assert_eq!(graded_name(&p4), "p4");
        let copied = graded_name(&found(p4.text()));
        assert!(copied.starts_with("p4-") && copied.len() == 19, "{copied}");
        assert_eq!(copied, graded_name(&found(p4.text())));
        let changed = found(&p4.text().replace("finish = ", "finish  = "));
        assert_ne!(copied, graded_name(&changed));
        let model =
            "[[levels.ug.sensors]]\nname = \"x\"\nmodel = \"vlp-17\"\nposition_m = [0, 0, 0.1]\n";
        let wrong = found(&format!("{}\n{model}", p4.text()));
        let made = CourseInstance::make(&wrong, Level::Ug, Variant::DAY, 1);
        let why = format!("{:#}", made.err().unwrap());
        assert!(why.contains("vlp-17") && why.contains("vlp-16"), "{why}");
    }

    #[test]
    fn a_place_is_known_by_its_hashes() {
        let project = CourseProject::named("forest").unwrap();
        let course =
            |variant, seed| CourseInstance::make(&project, Level::Ug, variant, seed).unwrap();
        let (one, again) = (course(Variant::DAY, 1), course(Variant::DAY, 1));
        assert_eq!(
            (one.scene_sha256.as_str(), &one.rules_sha256),
            (again.scene_sha256.as_str(), &again.rules_sha256)
        );
        let night = course("night".parse().unwrap(), 1);
        assert_eq!(night.rules_sha256, one.rules_sha256, "the rules are those of the day");
        assert_ne!(night.scene_sha256, one.scene_sha256);
        let rain = course("rain".parse().unwrap(), 1);
        assert_ne!(rain.scene_sha256, one.scene_sha256, "weather is part of what cameras see");
        assert_eq!(rain.rules_sha256, one.rules_sha256);
        let other = CourseInstance::make(&project, Level::G, Variant::DAY, 1).unwrap();
        assert_ne!(other.rules_sha256, one.rules_sha256);
    }
}
