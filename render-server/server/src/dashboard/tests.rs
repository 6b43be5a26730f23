use super::*;

#[test]
fn the_page_refers_only_to_files_that_are_served() {
    for wanted in ["/style.css", "/app.js", "/icon.svg"] {
        assert!(INDEX.contains(wanted), "{wanted}");
    }
    assert!(
        APP.contains("\"/map.js\"")
            && APP.contains("\"/cameras.js\"")
            && APP.contains("/api/estop")
            && MAP.contains("/api/map")
    );
}

/// Every field that the cameras panel reads or fills is in its form.
#[test]
fn every_field_of_the_cameras_panel_is_in_the_form() {
    let mut found = 0;
    for word in CAMERAS.split('"').skip(1).step_by(2) {
        let is_field = ["_px", "_m", "_hz", "_deg"].iter().any(|unit| word.ends_with(unit))
            && !["position_m"].contains(&word);
        let is_coefficient = word.len() == 2 && word.starts_with(['k', 'p']);
        if is_field || is_coefficient {
            assert!(INDEX.contains(&format!("name=\"{word}\"")), "{word}");
            found += 1;
        }
    }
    assert!(found > 20, "{found}");
}

/// Every element that the script looks up by its id is on the page.
#[test]
fn every_id_of_the_script_is_on_the_page() {
    let mut found = 0;
    for call in ["$(\"", "put(\"", "tone(\""] {
        for part in APP.split(call).skip(1) {
            let id = part.split('"').next().unwrap();
            assert!(INDEX.contains(&format!("id=\"{id}\"")), "{id}");
            found += 1;
        }
    }
    assert!(found > 30);
}
