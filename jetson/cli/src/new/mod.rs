//! `vizflyt new NAME`: makes a folder with a plugin that flies, its test and editor settings.
//!
//! The files come from `jetson/cli/templates`, with the names filled in. A project of the course
//! with a starter uses the starter's plugin, modules and tests instead.

mod course_folder;
mod starter;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context, Result, bail};
use clap::{Args, ValueEnum};
use vizflyt_grading::plugin::built_in::BuiltIn;
use vizflyt_grading::plugin::{manifest, own_python, sources};
use vizflyt_process::print_line;
use vizflyt_scenes::SceneKind;
use vizflyt_scenes::projects::{self, CourseProject};

/// Make a folder with a plugin that flies
///
/// The plugin climbs to 1 m and follows the depth gradient.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  vizflyt new first                    a plugin in Python; then: vizflyt fly first
  vizflyt new my-p4 --project p4       the starter of a course project, with tests
  vizflyt new ../second --lang rust")]
pub(crate) struct NewArgs {
    /// Folder to make; its last part is the name of the plugin
    #[arg(value_name = "NAME")]
    path: PathBuf,
    /// Programming language
    #[arg(long, value_enum, default_value_t)]
    lang: Language,
    #[arg(long, value_name = "NAME", help = format!(
        "Project: {}, {}", starter::IN_THE_NET.join(", "), projects::NAMES.join(", ")
    ), long_help = format!(
        "Course project: {}, {}; or a folder projects/NAME",
        starter::IN_THE_NET.join(", "),
        projects::NAMES.join(", ")
    ))]
    project: Option<String>,
}

/// Programming language of a plugin.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
enum Language {
    /// Python: plugin.py
    #[default]
    Python,
    /// Rust: src/main.rs
    Rust,
}

/// Makes the folder.
pub(crate) fn run(args: &NewArgs) -> Result<ExitCode> {
    let name = name_of(&args.path)?;
    let starter = args.project.as_deref().and_then(starter::of);
    if let (Some(project), Some(_), Language::Rust) = (&args.project, &starter, args.lang)
        && starter::IN_THE_NET.contains(&&**project)
    {
        bail!("{project} supports only Python; omit --lang");
    }
    let place = match &args.project {
        Some(name) if starter::IN_THE_NET.contains(&&**name) => {
            format!("project = {:?}", starter::NET)
        }
        Some(name) if CourseProject::named(name).is_ok() => format!("project = {name:?}"),
        Some(name) => {
            let roots: Vec<PathBuf> = sources().into_iter().collect();
            let known = starter::IN_THE_NET.iter().chain(projects::NAMES).copied();
            let known: Vec<&str> = known.collect();
            let folder = course_folder::find(name, &known, &roots)?;
            format!("scene = {:?}", folder.display().to_string())
        }
        None => "scene = \"forest\"".to_owned(),
    };
    if args.path.exists() {
        bail!("{} exists already; choose another name, or delete it", args.path.display());
    }
    let folder = args.path.display().to_string();
    let files = match args.lang {
        Language::Python => python(&name, &folder, &place, starter),
        Language::Rust => rust(&name, &folder, &place)?,
    };
    for (file, text) in files {
        let path = args.path.join(file);
        let write = || {
            fs::create_dir_all(path.parent().unwrap_or(&args.path))?;
            fs::write(&path, text)
        };
        write().with_context(|| format!("cannot write {}", path.display()))?;
    }
    print_line(format!("{folder} created; next"));
    // pip has installed the package with this program; in a source tree the package must be built.
    if args.lang == Language::Python && own_python().is_none() {
        let package = sources().map(|root| format!("{} ", root.join("jetson/python").display()));
        let package = package.unwrap_or_default();
        print_line(format!(
            "  python3 -m venv {folder}/.venv && {folder}/.venv/bin/pip install {package}-r {folder}/requirements.txt"
        ));
    }
    print_line(format!("  vizflyt fly {folder}"));
    Ok(ExitCode::SUCCESS)
}

/// Name and text of a file.
type File = (&'static str, String);

fn python(
    name: &str,
    folder: &str,
    place: &str,
    starter: Option<(&'static str, Vec<File>)>,
) -> Vec<File> {
    let fill = |text: &str| {
        let text = text.replace("{{name}}", name).replace("{{folder}}", folder);
        text.replace("{{class}}", &class(name)).replace("{{version}}", env!("CARGO_PKG_VERSION"))
    };
    let (plugin, own) = starter.unwrap_or_else(|| {
        let files = vec![
            ("plugin.py", fill(include_str!("../../templates/python/plugin.py"))),
            ("test_plugin.py", fill(include_str!("../../templates/python/test_plugin.py"))),
            ("README.md", fill(include_str!("../../templates/python/README.md"))),
        ];
        ("plugin.py", files)
    });
    let common = [
        ("requirements.txt", fill(include_str!("../../templates/python/requirements.txt"))),
        ("pyrightconfig.json", fill(include_str!("../../templates/python/pyrightconfig.json"))),
        (".vscode/settings.json", fill(include_str!("../../templates/python/settings.json"))),
        (".gitignore", fill(include_str!("../../templates/python/gitignore"))),
        (manifest::FILE, lab(plugin, place)),
    ];
    own.into_iter().chain(common).collect()
}

fn rust(name: &str, folder: &str, place: &str) -> Result<Vec<File>> {
    // Formatted as a JSON string: TOML quotes paths in the same way.
    let sources = sources().context("a plugin in Rust is built with VizFlyt's own crates")?;
    let sdk = format!("path = {:?}", sources.join("jetson/sdk").display().to_string());
    let fill = |text: &str| {
        let text = text.replace("{{name}}", name).replace("{{folder}}", folder);
        text.replace("{{class}}", &class(name)).replace("{{sdk}}", &sdk)
    };
    Ok(vec![
        ("Cargo.toml", fill(include_str!("../../templates/rust/Cargo.toml"))),
        // Versions that the SDK is tested with; cargo drops those that the plugin does not need.
        ("Cargo.lock", include_str!("../../../../Cargo.lock").to_owned()),
        ("src/main.rs", fill(include_str!("../../templates/rust/main.rs"))),
        ("README.md", fill(include_str!("../../templates/rust/README.md"))),
        (".vscode/settings.json", fill(include_str!("../../templates/rust/settings.json"))),
        (".gitignore", fill(include_str!("../../templates/rust/gitignore"))),
        (manifest::FILE, lab("Cargo.toml", place)),
    ])
}

fn lab(plugin: &str, place: &str) -> String {
    let text = include_str!("../../templates/vizflyt.toml");
    text.replace("{{plugin}}", plugin)
        .replace("{{place}}", place)
        .replace("{{scenes}}", &SceneKind::names())
        .replace("{{projects}}", &projects::NAMES.join(", "))
}

/// Returns the plugin's name if it is valid as a folder, a crate and a class.
fn name_of(path: &Path) -> Result<String> {
    let name = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let is_good = name.starts_with(|c: char| c.is_ascii_alphabetic())
        && name.chars().all(|c| c.is_ascii_alphanumeric() || c == '_' || c == '-')
        && name.len() <= MAX_NAME_BYTES;
    if !is_good {
        bail!(
            "'{name}' is not a valid plugin name: use a letter, then letters, digits, - and _, at most \
             {MAX_NAME_BYTES}"
        );
    }
    if BuiltIn::from_str(&name, true).is_ok() {
        bail!("'{name}' is a built-in plugin; choose another name");
    }
    let words = [name.to_ascii_lowercase(), class(&name)];
    if words.iter().any(|word| TAKEN.contains(&word.as_str())) {
        bail!("'{name}' is the name of a package that the plugin needs; choose another name");
    }
    Ok(name)
}

/// Same limit as for the names in an arena.
const MAX_NAME_BYTES: usize = 32;
/// Names that cargo rejects, or that would shadow imports of the plugin.
const TAKEN: [&str; 18] = [
    "vizflyt",
    "vizflyt-sdk",
    "vizflyt_sdk",
    "test",
    "core",
    "std",
    "alloc",
    "numpy",
    "plugin",
    "self",
    "Autonomy",
    "Axes",
    "CameraImage",
    "Event",
    "Observation",
    "Option",
    "Setpoint",
    "YawTarget",
];

/// Returns the name as a class: `my-first_plugin` is `MyFirstPlugin`.
fn class(name: &str) -> String {
    let word = |word: &str| {
        let mut letters = word.chars();
        let first = letters.next().map(|c| c.to_ascii_uppercase());
        first.into_iter().chain(letters).collect::<String>()
    };
    name.split(['-', '_']).map(word).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rejects_invalid_names() {
        let check = |name: &str, good: bool| {
            assert_eq!(name_of(Path::new(name)).is_ok(), good, "{name}");
        };
        check("first", true);
        check("../my-first_2", true);
        for name in ["", "..", "/", "2nd", "-x", "a b", "ä", "avoid", "vizflyt", "Test", "event"] {
            check(name, false);
        }
        check(&"a".repeat(33), false);
    }

    #[test]
    fn classes_are_camel_case() {
        for (name, expected) in
            [("first", "First"), ("my-first_plugin", "MyFirstPlugin"), ("a--b", "AB"), ("aB", "AB")]
        {
            assert_eq!(class(name), expected);
        }
    }

    #[test]
    fn fills_every_placeholder_and_keeps_the_readme_within_ten_lines() {
        let both = [
            python("a-b", "x/a-b", "scene = \"room\"", None),
            rust("a-b", "x/a-b", "project = \"p5\"").unwrap(),
        ];
        for (file, text) in both.iter().flatten() {
            assert!(!text.contains("{{"), "{file}: {text}");
            assert!(!text.is_empty(), "{file}");
            if *file == "README.md" {
                assert!(text.lines().count() <= 10, "{text}");
            }
        }
    }
}
