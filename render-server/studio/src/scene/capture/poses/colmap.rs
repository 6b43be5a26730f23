//! COLMAP as a program in the PATH, version 3.8 and later.

use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::Result;

use super::tool::ask;
use super::{Finder, Job, Phase, Tool, UNKNOWN_LENS};

/// COLMAP program.
pub(super) struct Colmap {
    program: PathBuf,
    name: String,
    /// Prefix of feature options: "Sift" until 3.12, then "Feature".
    prefix: &'static str,
}

impl Colmap {
    /// Runs the program to read its version; `None` if it is not installed.
    pub(super) fn open(program: &Path) -> Option<Self> {
        let help = ask(Command::new(program).arg("help"))?;
        let options =
            ask(Command::new(program).args(["feature_extractor", "-h"])).unwrap_or_default();
        let name = version(&help).unwrap_or_else(|| "COLMAP".to_owned());
        let is_new = options.contains("FeatureExtraction.use_gpu");
        let prefix = if is_new { "Feature" } else { "Sift" };
        Some(Self { program: program.to_owned(), name, prefix })
    }
}

/// Returns the name and version from the output of `colmap help`, such as "COLMAP 3.8".
fn version(help: &str) -> Option<String> {
    let line = help.lines().find(|line| line.starts_with("COLMAP "))?;
    let mut words = line.split_whitespace();
    Some(format!("{} {}", words.next()?, words.next()?))
}

impl Finder for Colmap {
    fn name(&self) -> &str {
        &self.name
    }

    fn find(&self, job: &Job<'_>, progress: &mut dyn FnMut(Phase)) -> Result<()> {
        let log = job.folder.join("log.txt");
        let tool = Tool { name: &self.name, log: &log };
        let database = job.folder.join("database.db");
        let command = |what: &str| {
            let mut command = Command::new(&self.program);
            command.arg(what).arg("--database_path").arg(&database);
            // With this platform, Qt needs no display.
            command.env("QT_QPA_PLATFORM", "offscreen");
            command
        };
        let mut features = command("feature_extractor");
        features.arg("--image_path").arg(job.images).args(["--ImageReader.single_camera", "1"]);
        let (model, parameters) = job.lens.clone().unwrap_or((UNKNOWN_LENS, String::new()));
        features.args(["--ImageReader.camera_model", model]);
        if job.lens.is_some() {
            features.args(["--ImageReader.camera_params", &parameters]);
        }
        features.args([&format!("--{}Extraction.use_gpu", self.prefix), "0"]);
        features.args(["--SiftExtraction.max_num_features", "4096"]);
        tool.run(&mut features, progress)?;

        let mut matching = command("matches_importer");
        matching.arg("--match_list_path").arg(job.pairs).args(["--match_type", "pairs"]);
        matching.args([&format!("--{}Matching.use_gpu", self.prefix), "0"]);
        tool.run(&mut matching, progress)?;

        let mut mapping = command("mapper");
        mapping.arg("--image_path").arg(job.images).arg("--output_path").arg(job.models);
        if job.lens.is_some() {
            for what in ["focal_length", "extra_params"] {
                mapping.args([&format!("--Mapper.ba_refine_{what}"), "0"]);
            }
        }
        tool.run(&mut mapping, progress)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_the_version_from_the_help() {
        let help =
            "COLMAP 3.8 -- Structure-from-Motion and Multi-View Stereo\n  (Commit Unknown)\n";
        assert_eq!(version(help).as_deref(), Some("COLMAP 3.8"));
        assert_eq!(version("colmap: command not found"), None);
    }
}
