use super::*;

#[test]
fn the_page_refers_only_to_files_that_are_served() {
    for wanted in ["/style.css", "/app.js", "/icon.svg"] {
        assert!(INDEX.contains(wanted), "{wanted}");
    }
    assert!(APP.contains("\"/map.js\"") && APP.contains("/api/estop") && MAP.contains("/api/map"));
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
