//! Course of a graded flight: an instance of a project, generated from a seed.

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

/// Generated course. It exists only in the memory of this process, so that no plugin can read it.
pub struct CourseInstance {
    /// Room and rules.
    pub arena: ArenaConfig,
    /// Static splats. [m, world]
    pub splats: Splats,
    /// Moving objects. [m, object]
    pub objects: Vec<RigidObject>,
    /// Distance field of the static obstacles, for the referee.
    pub field: Arc<DistanceField>,
    /// Static and moving obstacles; their clock is 0 at the start of a flight.
    pub obstacles: Obstacles,
    /// Map for plugins as JSON, if the course provides one.
    pub map: Option<String>,
    /// SHA-256 of splats, objects, light and weather.
    pub scene_sha256: String,
    /// SHA-256 of the rules: project file and arena file.
    pub rules_sha256: String,
}

/// Returns the name of a project in grades. The name of a project from a file includes a hash of the file: a changed
/// file is another project, and no file can pass for one of the built-in projects.
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
    /// A sensor model is invalid, or the arena cannot be serialized. A test excludes both for the built-in projects.
    pub fn make(
        project: &CourseProject,
        level: Level,
        variant: Variant,
        seed: u64,
    ) -> Result<Self> {
        let generated = project.generate(seed, level, variant);
        SensorSet::new(&generated.arena.sensors).context("the course's sensors")?;
        // Not cached: on the disk, it would be a map for the next plugin.
        let baked =
            bake_with(&generated.splats, &BakeSpec::of(&generated.arena), None, None, &|_| ());
        // Light and fog are part of the scene's hash, not of the rules' hash.
        let environment = generated.arena.environment;
        let rules =
            ArenaConfig { environment: EnvironmentConfig::default(), ..generated.arena.clone() };
        let rules = rules.to_toml().context("the arena cannot be serialized")?;
        let mut hash = Sha256::new();
        hash.update(project.text());
        hash.update([0]);
        hash.update(rules);
        let field = Arc::new(baked.field);
        let truth = Some(&generated.truth).filter(|_| generated.map_is_known);
        let map =
            truth.map(serde_json::to_string).transpose().context("the map cannot be serialized")?;
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
        // Weather is hashed as its text: the same numbers give the same text.
        hash.update(
            serde_json::to_string(environment).context("the weather cannot be serialized")?,
        );
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
    fn a_project_from_a_file_never_has_the_name_of_a_built_in_one() {
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
    fn hashes_distinguish_scene_weather_and_rules() {
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
