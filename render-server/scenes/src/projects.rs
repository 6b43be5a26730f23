//! Projects of the course: contents of the net, sensors and known data of the vehicle, and rules. Each is defined by a
//! file (`render-server/scenes/projects/*.toml`).
//!
//! ```text
//! projects/p5.toml -> CourseProject -> generate(seed, level, variant) -> Generated
//! ```
//! The seed determines the place (see [`generate`](crate::generate)), the level determines the sensors, and the variant
//! determines light and weather. Called once per flight.
//!
//! A new project needs its file, its name in [`NAMES`], and its row in `docs/guides/course.md`, which a test in this
//! module prints. Help, messages and defaults of the command line follow from the file. Instructors can also define a
//! project in a separate file of the same format ([`CourseProject::find`]).

use core::fmt;
use core::str::FromStr;
use std::borrow::Cow;
use std::path::{Path, PathBuf};

use serde::Deserialize;
use vizflyt_arena::ArenaConfig;
use vizflyt_arena::config::{CameraConfig, RulesConfig, SensorConfig, StageConfig};
use vizflyt_arena::points::PointsTable;
use vizflyt_protocol::messages::{Limits, SetpointKinds};

use crate::draw::DrawBounds;
use crate::hall::{self, Layout};
use crate::variant::Variant;
use crate::{Generated, forest};

/// Includes the files of `../projects` by name, in the order of the course.
macro_rules! projects {
    ($($name:literal)*) => {
        /// Names of all projects, in the order of the course.
        pub const NAMES: &[&str] = &[$($name),*];
        /// Files of the projects, in the same order.
        const FILES: &[&str] = &[$(include_str!(concat!("../projects/", $name, ".toml"))),*];
    };
}
projects!("p2" "p3" "p4" "p5" "forest" "square" "spiral" "lemniscate");

/// Project of the course.
#[derive(Clone, Debug, PartialEq)]
pub struct CourseProject {
    name: Cow<'static, str>,
    text: Cow<'static, str>,
    plan: ProjectFile,
}

/// Level of a course, which determines the sensors.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Level {
    /// Undergraduate: images with depth.
    #[default]
    Ug,
    /// Graduate: images without depth.
    G,
}

impl Level {
    /// All levels.
    pub const ALL: [Self; 2] = [Self::Ug, Self::G];

    /// Returns the name of the level on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Ug => "ug",
            Self::G => "g",
        }
    }
}

impl fmt::Display for Level {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

impl FromStr for Level {
    type Err = UnknownLevel;

    fn from_str(text: &str) -> Result<Self, UnknownLevel> {
        let known = Self::ALL.into_iter().find(|level| level.name() == text);
        known.ok_or_else(|| UnknownLevel(text.to_owned()))
    }
}

/// Unknown name of a [`Level`].
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("no level is called '{0}'; give ug (with depth) or g (without)")]
pub struct UnknownLevel(pub String);

/// Unknown name of a [`CourseProject`].
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("there is no project '{0}'; there are: {all}", all = NAMES.join(", "))]
pub struct UnknownProject(pub String);

/// Error of [`CourseProject::find`].
#[derive(Debug, thiserror::Error)]
pub enum NoProject {
    /// No project has this name.
    #[error("{0}; or give the path of a project file that ends with .toml")]
    Unknown(UnknownProject),
    /// The file cannot be read.
    #[error("cannot read the project {path}: {1}", path = .0.display())]
    Unreadable(PathBuf, std::io::Error),
    /// The file does not define a valid course.
    #[error("{path} is not a valid project: {1}", path = .0.display())]
    Wrong(PathBuf, String),
}

/// Content of a project file.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
struct ProjectFile {
    title: String,
    task: String,
    place: CoursePlace,
    finish: Finish,
    #[serde(default)]
    known_map: bool,
    ground_truth: bool,
    time_limit_s: f64,
    limits: Limits,
    /// Virtual gates, which come after the gates of the place.
    #[serde(default)]
    stages: Vec<StageConfig>,
    #[serde(default)]
    rules: RulesConfig,
    #[serde(default)]
    environments: DrawBounds,
    levels: Levels,
}

#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum CoursePlace {
    Forest,
    Net(Layout),
}

/// End of a flight.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
enum Finish {
    /// In the goal, after all stages.
    #[serde(rename = "goal")]
    Goal,
    /// After the last stage.
    #[serde(rename = "last stage")]
    LastStage,
}

#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
struct Levels {
    ug: LevelPlan,
    g: LevelPlan,
}

#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
struct LevelPlan {
    /// Allowed setpoints, if they differ from `[rules]`.
    #[serde(default)]
    setpoints: Option<SetpointKinds>,
    cameras: Vec<CameraConfig>,
    #[serde(default)]
    sensors: Vec<SensorConfig>,
    /// Points for the results of a grade.
    #[serde(default)]
    points: Option<PointsTable>,
}

impl CourseProject {
    /// Returns the built-in project with this name.
    ///
    /// ```
    /// use vizflyt_scenes::projects::{Level, CourseProject};
    /// use vizflyt_scenes::Variant;
    /// let race = CourseProject::named("p5").unwrap();
    /// let generated = race.generate(3, Level::Ug, Variant::DAY);
    /// let names: Vec<_> = generated.arena.stages.iter().map(|stage| &*stage.name).collect();
    /// assert_eq!(names, ["window 1", "window 2", "gap", "clock hand"]);
    /// assert!(!generated.arena.ground_truth);
    /// assert!(CourseProject::named("p9").unwrap_err().to_string().contains("p2, p3"));
    /// ```
    ///
    /// # Errors
    /// [`UnknownProject`], which lists the names.
    ///
    /// # Panics
    /// The file of a built-in project is invalid, which a test excludes.
    pub fn named(name: &str) -> Result<Self, UnknownProject> {
        let mut files = NAMES.iter().zip(FILES);
        let (name, text) = files
            .find(|(known, _)| **known == name)
            .ok_or_else(|| UnknownProject(name.to_owned()))?;
        let plan = vizflyt_toml::parse(text).unwrap_or_else(|error| panic!("{name}.toml: {error}"));
        Ok(Self { name: Cow::Borrowed(name), text: Cow::Borrowed(text), plan })
    }

    /// Returns the built-in project with this name, or the project of a file if the path ends with `.toml`. Its name is
    /// then the name of the file.
    ///
    /// # Errors
    /// [`NoProject`]: the name is unknown, or the file cannot be read or does not define a valid course.
    pub fn find(name_or_path: &str) -> Result<Self, NoProject> {
        let path = Path::new(name_or_path);
        if path.extension().is_none_or(|ending| ending != "toml") {
            return Self::named(name_or_path).map_err(NoProject::Unknown);
        }
        let text = std::fs::read_to_string(path)
            .map_err(|error| NoProject::Unreadable(path.to_owned(), error))?;
        let wrong = |why: String| NoProject::Wrong(path.to_owned(), why);
        let plan: ProjectFile =
            vizflyt_toml::parse(&text).map_err(|errors| wrong(errors.to_string()))?;
        plan.environments.check().map_err(|error| wrong(error.to_string()))?;
        let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let project = Self { name: Cow::Owned(name), text: Cow::Owned(text), plan };
        for level in Level::ALL {
            let arena = project.generate(1, level, Variant::DAY).arena;
            arena.validate().map_err(|error| wrong(format!("level {level}: {error}")))?;
            let points = project.points(level).map_or(Ok(()), PointsTable::check);
            points.map_err(|error| wrong(format!("level {level}: {error}")))?;
        }
        Ok(project)
    }

    /// Returns all built-in projects.
    pub fn all() -> impl Iterator<Item = Self> {
        NAMES.iter().filter_map(|name| Self::named(name).ok())
    }

    /// Returns the name, such as `p5`.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Whether the project was read from a file and is not built in, independent of its name.
    pub fn is_from_file(&self) -> bool {
        matches!(self.text, Cow::Owned(_))
    }

    /// Returns the title.
    pub fn title(&self) -> &str {
        &self.plan.title
    }

    /// Returns the description of the task.
    pub fn task(&self) -> &str {
        self.plan.task.trim()
    }

    /// Whether the course ends with the last stage, as in races, instead of a goal.
    pub fn is_race(&self) -> bool {
        self.plan.finish == Finish::LastStage
    }

    /// Returns the bounds of random environments.
    pub fn environments(&self) -> &DrawBounds {
        &self.plan.environments
    }

    /// Returns the text of the file, which contains all rules. Grades contain its hash.
    pub fn text(&self) -> &str {
        &self.text
    }

    /// Returns the table of points at a level, if the project has one.
    pub fn points(&self, level: Level) -> Option<&PointsTable> {
        self.level(level).points.as_ref()
    }

    fn level(&self, level: Level) -> &LevelPlan {
        match level {
            Level::Ug => &self.plan.levels.ug,
            Level::G => &self.plan.levels.g,
        }
    }

    /// Generates the place of a seed, with the sensors of a level, in the environment of a variant. The same arguments
    /// give the same result on every machine.
    pub fn generate(&self, seed: u64, level: Level, variant: Variant) -> Generated {
        let plan = &self.plan;
        let mut generated = match plan.place {
            CoursePlace::Forest => forest::build(seed),
            CoursePlace::Net(layout) => hall::build_course(seed, &self.name, layout),
        };
        let suite = self.level(level);
        let arena = &mut generated.arena;
        *arena = ArenaConfig {
            name: self.name.clone().into_owned(),
            time_limit_s: plan.time_limit_s,
            ground_truth: plan.ground_truth,
            limits: plan.limits,
            rules: RulesConfig {
                setpoints: suite.setpoints.or(plan.rules.setpoints),
                start_box: plan.rules.start_box.or(arena.rules.start_box),
                ..plan.rules
            },
            cameras: suite.cameras.clone(),
            sensors: suite.sensors.clone(),
            environment: variant.environment(),
            goal: arena.goal.filter(|_| plan.finish == Finish::Goal),
            stages: arena.stages.iter().chain(&plan.stages).cloned().collect(),
            ..arena.clone()
        };
        generated.map_is_known = plan.known_map;
        generated
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use glam::DVec3;
    use vizflyt_protocol::messages::SetpointKind;

    use super::*;

    #[test]
    fn finds_projects_by_name_or_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scanned.toml");
        let found = |text: &str| {
            std::fs::write(&path, text).unwrap();
            CourseProject::find(path.to_str().unwrap())
        };
        let (p4, p5) = (CourseProject::named("p4").unwrap(), CourseProject::named("p5").unwrap());
        let own = found(p4.text()).unwrap();
        assert_eq!((own.name(), own.text()), ("scanned", p4.text()));
        assert_eq!(CourseProject::find("p4").unwrap(), p4);
        let text = format!(
            "{}\n[[levels.ug.sensors]]\nname = \"top\"\nmodel = \"vlp-16\"\nposition_m = [0.0, 0.0, 0.1]\n",
            p5.text()
        );
        let own = found(&text).unwrap();
        let of = |level| own.generate(2, level, Variant::DAY).arena;
        assert_eq!((of(Level::Ug).sensors.len(), of(Level::G).sensors.len()), (1, 0));
        let fast = text.replace("max_speed_mps = 4.0", "max_speed_mps = 99.0");
        let error = found(&fast).unwrap_err().to_string();
        assert!(error.contains("level ug") && error.contains("limits.max_speed_mps"), "{error}");
        let turned = p4.text().replace("all = 14.0, half = 23.0", "all = 23.0, half = 14.0");
        let error = found(&turned);
        let error = error.unwrap_err().to_string();
        assert!(error.contains("level ug: points.time_s"), "{error}");
        let error = found(&text.replace("finish", "fnish")).unwrap_err().to_string();
        assert!(error.contains("scanned.toml") && error.contains("line "), "{error}");
        let error = CourseProject::find("nowhere.toml").unwrap_err().to_string();
        assert!(error.contains("cannot read the project nowhere.toml"), "{error}");
        let error = CourseProject::find("p9").unwrap_err().to_string();
        assert!(error.contains("p2, p3") && error.contains(".toml"), "{error}");
    }

    #[test]
    fn bounds_of_environments_are_valid() {
        for project in CourseProject::all() {
            project
                .environments()
                .check()
                .unwrap_or_else(|error| panic!("{}: {error}", project.name()));
        }
    }

    #[test]
    fn allows_velocity_setpoints_in_p2_only_for_graduates() {
        let project = CourseProject::all().find(|project| project.name() == "p2").unwrap();
        let allows = |level, kind| {
            let arena = project.generate(3, level, Variant::DAY).arena;
            arena.info().setpoints.contains(kind)
        };
        for level in Level::ALL {
            assert!(
                allows(level, SetpointKind::Position) && allows(level, SetpointKind::Trajectory)
            );
            assert_eq!(allows(level, SetpointKind::Velocity), level == Level::G);
            assert!(!allows(level, SetpointKind::AttitudeRate));
        }
    }

    #[test]
    fn all_projects_generate_valid_arenas() {
        for (project, &name) in CourseProject::all().zip(NAMES) {
            assert_eq!(project.name(), name);
            assert!(!project.title().is_empty() && project.task().len() > 40, "{name}");
            for level in Level::ALL {
                let generated = project.generate(3, level, Variant::DAY);
                let arena = &generated.arena;
                arena.validate().unwrap_or_else(|error| panic!("{name}: {error}"));
                assert_eq!(arena.name, name);
                let depth = arena.cameras.iter().all(|camera| camera.depth);
                assert_eq!(depth, level == Level::Ug, "{name} {level}");
                // A flight can succeed: in a goal or after the last stage.
                assert!(arena.goal.is_some() || !arena.stages.is_empty(), "{name}");
            }
        }
        assert_eq!(CourseProject::all().count(), NAMES.len());
    }

    #[test]
    fn the_guide_has_a_row_for_each_project() {
        let guide = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/guides/course.md");
        let guide = std::fs::read_to_string(guide).unwrap();
        let head = "| project | what | in | finish | a plugin knows |\n|---|---|---|---|---|\n";
        let rows: String = CourseProject::all().map(|project| row(&project)).collect();
        assert!(guide.contains(&format!("{head}{rows}\n")), "course.md lacks\n{head}{rows}");
    }

    fn row(project: &CourseProject) -> String {
        let place = match project.plan.place {
            CoursePlace::Forest => "the forest".to_owned(),
            CoursePlace::Net(layout) => parts(layout).join(", "),
        };
        let finish = if project.is_race() { "the last stage" } else { "the goal" };
        let pose = if project.plan.ground_truth { ", its pose" } else { "" };
        let map = if project.plan.known_map { ", [the map](#stages)" } else { "" };
        format!(
            "| `{}` | {} | {place} | {finish} | images, IMU, attitude{pose}{map} |\n",
            project.name(),
            project.title()
        )
    }

    fn parts(layout: Layout) -> Vec<String> {
        let Layout { windows, gap, hand, pillars, door, pendulum, drone } = layout;
        let named = [
            (pillars, "pillars"),
            (gap, "a gap"),
            (hand, "a window with a rotating hand"),
            (door, "a sliding door"),
            (pendulum, "a pendulum"),
            (drone, "another drone"),
        ];
        let windows = (windows > 0).then(|| format!("{windows} windows"));
        let named = named.into_iter().filter(|(there, _)| *there);
        let mut parts: Vec<_> =
            windows.into_iter().chain(named.map(|(_, name)| name.to_owned())).collect();
        if parts.is_empty() {
            parts.push("the empty net".to_owned());
        }
        parts
    }

    /// Returns the path of an odometry project, relative to the takeoff, for `s` from 0 to 1, as in its task. [m]
    fn path_m(name: &str, s: f64) -> DVec3 {
        match name {
            "square" => {
                let corners =
                    [(0.0, 0.0), (0.0, -1.4), (2.8, -1.4), (2.8, 1.4), (0.0, 1.4), (0.0, 0.0)];
                let corners = corners.map(|(x, y)| DVec3::new(x, y, 0.0));
                let mut left_m = s * 11.2;
                for side in corners.windows(2) {
                    let length_m = side[0].distance(side[1]);
                    if left_m <= length_m {
                        return side[0].lerp(side[1], left_m / length_m);
                    }
                    left_m -= length_m;
                }
                corners[5]
            }
            "spiral" => {
                let (sin, cos) = (4.0 * PI * s).sin_cos();
                let r_m = 1.5 - 0.9 * s;
                DVec3::new(1.5 - r_m * cos, -r_m * sin, 0.8 * s)
            }
            "lemniscate" => {
                let (sin, cos) = (2.0 * PI * s).sin_cos();
                let size_m = 2.5 / (1.0 + sin * sin);
                DVec3::new(2.5 - size_m * cos, size_m * sin * cos, 0.0)
            }
            _ => panic!("no path of {name}"),
        }
    }

    #[test]
    fn gates_of_odometry_projects_lie_on_their_paths_in_order() {
        for name in ["square", "spiral", "lemniscate"] {
            let arena =
                CourseProject::named(name).unwrap().generate(3, Level::G, Variant::DAY).arena;
            assert!(arena.stages.len() >= 8 && !arena.ground_truth, "{name}");
            let from_m = arena.spawn.position_m + DVec3::Z * arena.takeoff_height_m;
            let mut passed = 0;
            for n in 0..100_000_u32 {
                let (before_m, after_m) =
                    (path_m(name, f64::from(n) * 1e-5), path_m(name, f64::from(n + 1) * 1e-5));
                let Some(stage) = arena.stages.get(passed) else { break };
                let to_m = stage.center_m - from_m;
                if before_m.distance(to_m) < 2e-3 {
                    let ahead = (after_m - before_m).with_z(0.0).normalize();
                    assert!(ahead.dot(stage.normal.normalize()) > 0.999, "{name} {}", stage.name);
                    passed += 1;
                }
            }
            assert_eq!(passed, arena.stages.len(), "{name}: a gate is not on the path");
        }
    }

    #[test]
    fn levels_parse_and_print() {
        for level in Level::ALL {
            assert_eq!(level.to_string().parse(), Ok(level));
        }
        assert!("x".parse::<Level>().unwrap_err().to_string().contains("'x'"));
    }
}
