//! Scenes that can be chosen on the page: the arenas in one folder, by the names of their folders.

use std::path::{Path, PathBuf};
use std::sync::Mutex;

use vizflyt_process::lock;

/// Available scenes, and the chosen one.
#[derive(Debug)]
pub struct Scenes {
    folder: Option<PathBuf>,
    now: PathBuf,
    chosen: Mutex<Option<PathBuf>>,
}

impl Scenes {
    /// Creates the list for a server that shows the arena `now`; empty without a `folder`.
    pub fn new(folder: Option<&Path>, now: &Path) -> Self {
        Self { folder: folder.map(Path::to_owned), now: now.to_owned(), chosen: Mutex::default() }
    }

    /// Returns the available scenes, sorted by name: subfolders that contain an arena.toml.
    pub fn list(&self) -> Vec<(String, PathBuf)> {
        let Some(folder) = &self.folder else { return Vec::new() };
        let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
        let mut scenes: Vec<_> = entries
            .filter_map(|entry| {
                let name = entry.file_name().into_string().ok()?;
                let arena = entry.path().join("arena.toml");
                (!name.starts_with('.') && arena.is_file()).then_some((name, arena))
            })
            .collect();
        scenes.sort();
        scenes.truncate(MAX_SCENES);
        scenes
    }

    /// Returns the name of the present scene, if it is in the list.
    pub fn current(&self) -> Option<String> {
        let real = |path: &Path| {
            let arena = if path.is_dir() { path.join("arena.toml") } else { path.to_owned() };
            arena.canonicalize().ok()
        };
        let now = real(&self.now)?;
        self.list()
            .into_iter()
            .find(|(_, arena)| real(arena).as_ref() == Some(&now))
            .map(|(n, _)| n)
    }

    /// Chooses a scene by name; it is loaded when the present round of serving has ended.
    ///
    /// # Errors
    /// The scene does not exist or cannot be used, as text for the user.
    pub fn choose(&self, name: &str) -> Result<(), String> {
        let scenes = self.list();
        let Some((_, arena)) = scenes.iter().find(|(known, _)| known == name) else {
            let names: Vec<_> = scenes.iter().map(|(name, _)| name.as_str()).collect();
            return Err(match names.as_slice() {
                [] => "there is no scene to choose from; start the server with --scenes DIR"
                    .to_owned(),
                names => format!("there is no scene '{name}'; there are {}", names.join(", ")),
            });
        };
        // Errors are reported before the present scene is closed.
        super::parse_arena(arena).map_err(|error| format!("{error:#}"))?;
        *lock(&self.chosen) = Some(arena.clone());
        Ok(())
    }

    /// Returns the chosen scene, once.
    pub fn take_chosen(&self) -> Option<PathBuf> {
        lock(&self.chosen).take()
    }
}

/// Maximum number of scenes in the list.
const MAX_SCENES: usize = 100;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scenes_are_chosen_by_name_among_those_in_the_folder() {
        let folder = tempfile::tempdir().unwrap();
        let room = folder.path().join("lab/room");
        for name in ["lab/room", "lab/.hidden", "lab/empty", "outside"] {
            std::fs::create_dir_all(folder.path().join(name)).unwrap();
        }
        for name in ["lab/room", "lab/.hidden", "outside"] {
            std::fs::write(folder.path().join(name).join("arena.toml"), "name = 3").unwrap();
        }
        let scenes = Scenes::new(Some(&folder.path().join("lab")), &room);
        let names: Vec<_> = scenes.list().into_iter().map(|(name, _)| name).collect();
        assert_eq!(names, ["room"]);
        assert_eq!(scenes.current().as_deref(), Some("room"));
        for elsewhere in ["../outside", "outside", ".hidden", "", "/", "room/../room"] {
            let error = scenes.choose(elsewhere).unwrap_err();
            assert!(error.contains("there are room"), "{error}");
        }
        assert!(scenes.choose("room").unwrap_err().contains("arena.toml is wrong"));
        assert_eq!(scenes.take_chosen(), None);
        let none = Scenes::new(None, &room);
        assert!(none.choose("room").unwrap_err().contains("--scenes"));
        assert_eq!(none.current(), None);
    }
}
