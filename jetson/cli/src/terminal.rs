//! What people see outside a flight: lines on standard output, and the page in a browser.

/// Prints a line for people; unlike `println!` it does not panic when nobody reads any more.
pub(crate) fn tell(line: impl std::fmt::Display) {
    use std::io::Write;
    let mut out = std::io::stdout().lock();
    let _ = writeln!(out, "{line}").and_then(|()| out.flush());
}

/// Opens the page where there is a desktop; the address is printed in any case.
pub(crate) fn open_browser(url: &str) {
    let opener = if cfg!(target_os = "macos") { "open" } else { "xdg-open" };
    let quiet = std::process::Stdio::null;
    let spawned = std::process::Command::new(opener)
        .arg(url)
        .stdin(quiet())
        .stdout(quiet())
        .stderr(quiet())
        .spawn();
    if spawned.is_err() {
        tell("            open it in a browser");
    }
}
