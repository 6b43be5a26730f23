use std::path::Path;

use super::routes::FILES;

fn text(name: &str) -> &'static str {
    let found = FILES.iter().find(|(file, _)| *file == name);
    found.unwrap_or_else(|| panic!("{name} is not served")).1
}

/// The timing panel uses the interval edges of the runtime's reports.
#[test]
fn the_timing_panel_uses_the_interval_edges_of_the_reports() {
    let edges = vizflyt_protocol::messages::INTERVAL_EDGES_MS.map(|edge| edge.to_string());
    assert!(text("/panels/timing.js").contains(&format!("[{}]", edges.join(", "))));
}

#[test]
fn every_id_of_the_scripts_is_on_the_page() {
    let mut found = 0;
    let pages = [text("/index.html"), text("/wall.html"), text("/lab.html")];
    let is_ours = |file: &str| {
        !file.starts_with("/three/") && Path::new(file).extension().is_some_and(|kind| kind == "js")
    };
    for (file, script) in FILES.iter().filter(|(file, _)| is_ours(file)) {
        for part in script.split("$(\"").skip(1) {
            let id = format!("id=\"{}\"", part.split('"').next().unwrap());
            assert!(pages.iter().any(|page| page.contains(&id)), "{file}: {id}");
            found += 1;
        }
    }
    assert!(found > 30, "{found}");
}
