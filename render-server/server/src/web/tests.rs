use super::routes::{APP, CAMERAS, INDEX, MAP, PAIRING, WATERFALL};

#[test]
fn the_page_refers_only_to_files_that_are_served() {
    for wanted in ["/style.css", "/app.js", "/waterfall.js", "/pairing.js", "/icon.svg"] {
        assert!(INDEX.contains(wanted), "{wanted}");
    }
    assert!(
        APP.contains("\"/map.js\"")
            && APP.contains("\"/cameras.js\"")
            && APP.contains("/api/estop")
            && APP.contains("/api/vehicles")
            && MAP.contains("/api/map")
            && PAIRING.contains("/api/pairing")
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

/// The timing panel knows every stage and every reason, and the edges that the runtime counts by.
#[test]
fn the_timing_panel_speaks_the_words_of_the_reports() {
    for stage in vizflyt_protocol::messages::Stage::ALL {
        assert!(WATERFALL.contains(&format!("  {}: \"", stage.name())), "{}", stage.name());
    }
    for (reason, _) in crate::stream::delivery::Skipped::default().each() {
        assert!(WATERFALL.contains(&format!("  {reason}: \"")), "{reason}");
    }
    let edges = vizflyt_protocol::messages::INTERVAL_EDGES_MS.map(|edge| edge.to_string());
    assert!(WATERFALL.contains(&format!("[{}]", edges.join(", "))));
    for id in ["timing", "timing-body"] {
        assert!(
            WATERFALL.contains(&format!("(\"{id}\")")) && INDEX.contains(&format!("id=\"{id}\""))
        );
    }
    assert!(WATERFALL.contains("/api/stats"));
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
