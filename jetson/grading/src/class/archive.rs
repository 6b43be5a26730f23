//! A submission as a ZIP archive. Archives may be malicious: `open` rejects paths outside the
//! archive, links, and more than [`MOST_BYTES`], and leaves out the same names as for a folder.

use std::io::{Cursor, Read, Write};

use anyhow::{Context, Result, ensure};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

use crate::door;
pub use crate::door::{Files, MOST_BYTES, MOST_FILES};

/// Makes an archive; equal files give equal bytes.
pub fn pack(files: &Files) -> Result<Vec<u8>> {
    let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
    let options = SimpleFileOptions::default()
        .compression_method(CompressionMethod::Deflated)
        .last_modified_time(zip::DateTime::default());
    for (path, content) in files {
        archive.start_file(path.as_str(), options)?;
        archive.write_all(content)?;
    }
    Ok(archive.finish()?.into_inner())
}

/// Reads an untrusted archive.
pub fn open(bytes: &[u8]) -> Result<Files> {
    let mut archive = ZipArchive::new(Cursor::new(bytes))?;
    ensure!(archive.len() <= MOST_FILES, "{} files are more than {MOST_FILES}", archive.len());
    let mut files = Files::new();
    let mut left = MOST_BYTES;
    for index in 0..archive.len() {
        let part = archive.by_index(index)?;
        let name = part.name()?.into_owned();
        if part.is_dir() {
            continue;
        }
        let Some(path) = door::path_of(&name)? else { continue };
        ensure!(part.is_file(), "'{}' is a link", name.escape_debug());
        // The size in the archive's header is not trusted.
        let mut content = Vec::new();
        part.take(left + 1).read_to_end(&mut content)?;
        left = left
            .checked_sub(content.len() as u64)
            .with_context(|| format!("the archive contains more than {MOST_BYTES} bytes"))?;
        ensure!(files.insert(path, content).is_none(), "'{}' occurs twice", name.escape_debug());
    }
    for path in files.keys() {
        let is_folder = path.match_indices('/').any(|(at, _)| files.contains_key(&path[..at]));
        ensure!(!is_folder, "'{}' has a file as its parent folder", path.escape_debug());
    }
    Ok(files)
}

/// Removes the outer folder that other programs put around all files.
pub fn without_outer_folder(files: Files) -> Files {
    let outer = files
        .keys()
        .next()
        .and_then(|path| path.split_once('/'))
        .map(|(outer, _)| format!("{outer}/"));
    match outer {
        Some(outer) if files.keys().all(|path| path.starts_with(&outer)) => files
            .into_iter()
            .map(|(path, content)| (path[outer.len()..].to_owned(), content))
            .collect(),
        _ => files,
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::path::{Component, Path};

    use proptest::prelude::*;

    use super::*;

    fn files(paths: &[&str]) -> Files {
        paths.iter().map(|path| ((*path).to_owned(), path.as_bytes().to_vec())).collect()
    }

    #[test]
    fn removes_the_outer_folder() {
        let inner = files(&["net/w.onnx", "plugin.py"]);
        // File managers pack the folder itself.
        let outer = inner.iter().map(|(path, content)| (format!("p4/{path}"), content.clone()));
        assert_eq!(without_outer_folder(outer.collect()), inner);
        assert_eq!(without_outer_folder(inner.clone()), inner);
    }

    #[test]
    fn rejects_paths_outside_the_archive_links_and_large_contents() {
        for path in ["../up", "/etc/x", "a/../../x", "a\\..\\x"] {
            let error = open(&pack(&files(&[path])).unwrap()).unwrap_err().to_string();
            assert!(error.contains("leads out"), "{path}: {error}");
        }
        let error = open(&pack(&files(&["a", "a/b"])).unwrap()).unwrap_err().to_string();
        assert!(error.contains("has a file as its parent folder"), "{error}");
        let bomb = BTreeMap::from([("zeros".to_owned(), vec![0; (MOST_BYTES + 1) as usize])]);
        let bytes = pack(&bomb).unwrap();
        assert!(bytes.len() < 1 << 20, "{}", bytes.len());
        assert!(open(&bytes).unwrap_err().to_string().contains("contains more than"));
        let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
        archive.add_symlink("x", "/etc/passwd", SimpleFileOptions::default()).unwrap();
        let bytes = archive.finish().unwrap().into_inner();
        assert!(open(&bytes).unwrap_err().to_string().contains("'x' is a link"));
    }

    #[test]
    fn leaves_out_settings_of_tools_and_build_output() {
        let all = files(&[
            "plugin.py",
            ".cargo/config.toml",
            "a/.cargo/config.toml",
            ".venv/bin/python3",
            "target/x",
            "__pycache__/p.py",
            "a.pyc",
        ]);
        let found = open(&pack(&all).unwrap()).unwrap();
        assert_eq!(found, files(&["plugin.py"]));
    }

    proptest! {
        #[test]
        fn reads_or_rejects_any_bytes(at in 0usize..300, value: u8, cut in 0usize..300) {
            let mut bytes = pack(&files(&["plugin.py", "net/w.onnx"])).unwrap();
            let at = at % bytes.len();
            bytes[at] = value;
            bytes.truncate(bytes.len() - cut % bytes.len());
            for (path, _) in open(&bytes).into_iter().flatten() {
                prop_assert!(Path::new(&path).components().all(|part| matches!(part, Component::Normal(_))));
            }
        }
    }
}
