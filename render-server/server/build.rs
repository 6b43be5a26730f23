//! Lists the page's files, so that the program holds them and serves each by its path below `PAGE`.

use std::fmt::Write as _;
use std::path::Path;
use std::{env, fs, io};

fn main() -> io::Result<()> {
    println!("cargo::rerun-if-changed={PAGE}");
    let folder = env::current_dir()?.join(PAGE);
    let mut files = Vec::new();
    list(&folder, "", &mut files)?;
    files.sort();
    let mut table = "&[\n".to_owned();
    for file in files {
        let path = format!("{}{file}", folder.display());
        let _ = writeln!(table, "    ({file:?}, include_str!({path:?})),");
    }
    table.push_str("]\n");
    let out = env::var_os("OUT_DIR").expect("cargo sets it");
    fs::write(Path::new(&out).join("page_files.rs"), table)
}

/// Adds the files below `folder` that browsers load, each as a path from the page's own folder on.
fn list(folder: &Path, prefix: &str, files: &mut Vec<String>) -> io::Result<()> {
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        let Ok(name) = entry.file_name().into_string() else { continue };
        let path = format!("{prefix}/{name}");
        if entry.file_type()?.is_dir() {
            list(&entry.path(), &path, files)?;
        } else if SERVED.iter().any(|kind| name.ends_with(kind)) {
            files.push(path);
        }
    }
    Ok(())
}

const PAGE: &str = "src/web/page";
/// Types and licences are for people.
const SERVED: [&str; 4] = [".html", ".css", ".js", ".svg"];
