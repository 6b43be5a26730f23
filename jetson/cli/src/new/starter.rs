//! Files that `vizflyt new --project pN` copies into a folder: the course's starters in
//! `docs/course`.

use super::File;

/// Lists files of a folder of `docs/course`.
macro_rules! files {
    ($folder:literal $($file:literal)*) => {
        &[$(($file, include_str!(concat!("../../../../docs/course/", $folder, "/", $file)))),*]
    };
}

/// Starter of one project, and the folders of `docs/course` that it consists of.
struct Starter {
    project: &'static str,
    /// File that is flown.
    plugin: &'static str,
    parts: &'static [&'static [(&'static str, &'static str)]],
}

/// Complete helper modules: quaternions, files, the flight.
const GIVEN: &[(&str, &str)] = files!("given" "attitude.py" "estimate.py" "flight.py");
/// Rules of the flight, and scoring of an attitude.
const ATTITUDE: &[(&str, &str)] = files!("." "attitude.toml" "score_attitude.py");

const STARTERS: &[Starter] = &[
    Starter {
        project: "p0",
        plugin: "live_complementary.py",
        parts: &[
            GIVEN,
            ATTITUDE,
            files!("p0/starter" "README.md" "complementary.py" "live_complementary.py" "test_complementary.py"),
        ],
    },
    Starter {
        project: "p1",
        plugin: "live_madgwick.py",
        parts: &[
            GIVEN,
            ATTITUDE,
            files!("p1/starter" "README.md" "live_madgwick.py" "live_ukf.py" "madgwick.py" "test_madgwick.py" "test_ukf.py" "ukf.py"),
        ],
    },
    Starter {
        project: "p2",
        plugin: "plugin.py",
        parts: &[files!(
            "p2/starter" "README.md" "planner.py" "planner_g.py" "plugin.py" "test_planner.py" "test_planner_g.py"
        )],
    },
    Starter {
        project: "p3",
        plugin: "plugin.py",
        parts: &[files!("p3/starter" "README.md" "plugin.py" "test_windows.py" "windows.py")],
    },
    Starter {
        project: "p4",
        plugin: "plugin.py",
        parts: &[files!("p4/starter" "README.md" "gap.py" "plugin.py" "test_gap.py")],
    },
    Starter {
        project: "p5",
        plugin: "plugin.py",
        parts: &[files!(
            "p5/starter" "README.md" "hand.py" "plugin.py" "score.py" "states.py" "test_hand.py" "test_score.py" "test_states.py"
        )],
    },
    Starter {
        project: "forest",
        plugin: "plugin.py",
        parts: &[files!(
            "forest/starter" "README.md" "plugin.py" "primitives.py" "sight.py" "test_primitives.py" "test_sight.py"
        )],
    },
];

/// Projects that are flown in the empty net instead of on a course.
pub(super) const IN_THE_NET: [&str; 2] = ["p0", "p1"];
/// File with the rules of these projects.
pub(super) const NET: &str = "attitude.toml";

/// Returns the plugin and the files of a project's starter, if it has one.
pub(super) fn of(project: &str) -> Option<(&'static str, Vec<File>)> {
    let starter = STARTERS.iter().find(|starter| starter.project == project)?;
    let files = starter.parts.iter().copied().flatten();
    Some((starter.plugin, files.map(|&(file, text)| (file, text.to_owned())).collect()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;
    use std::path::Path;

    /// Catches a file that is added to a starter in `docs/course` but not here.
    #[test]
    fn includes_every_file_of_each_starter() {
        let course = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/course");
        let names = |folder: &Path| -> BTreeSet<String> {
            let entries = std::fs::read_dir(folder).unwrap().map(Result::unwrap);
            let files = entries.filter(|entry| entry.file_type().unwrap().is_file());
            files.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect()
        };
        let mut with_starter = 0;
        for entry in std::fs::read_dir(&course).unwrap() {
            let project = entry.unwrap();
            let folder = project.path().join("starter");
            if !folder.is_dir() {
                continue;
            }
            with_starter += 1;
            let project = project.file_name().to_string_lossy().into_owned();
            let (plugin, files) = of(&project).expect("the project has a starter");
            let files: BTreeSet<String> =
                files.iter().map(|(file, _)| (*file).to_owned()).collect();
            assert!(files.contains(plugin), "{project}");
            let mut there = names(&folder);
            if IN_THE_NET.contains(&&*project) {
                there.extend(names(&course.join("given")));
                there.extend(["score_attitude.py".to_owned(), NET.to_owned()]);
            }
            assert_eq!(files, there, "{project}");
        }
        assert_eq!(with_starter, STARTERS.len());
    }
}
