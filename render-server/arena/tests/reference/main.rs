//! Tests that docs/guides/arena-reference.md matches the types that read `arena.toml`; it is generated from
//! them.
//!
//! `UPDATE=1 cargo test -p vizflyt-arena --test reference` writes the page again.

mod page;
mod probe;
mod source;

use std::collections::BTreeSet;

use toml::{Table, Value};
use vizflyt_arena::ArenaConfig;
use vizflyt_arena::config::Up;

use page::{Page, sections};
use probe::Place;
use source::{Kind, Shape, Types};

/// A complete arena, from which the page takes its examples.
const EXAMPLE: &str = include_str!("example.toml");

/// Top-level tables for the server: the arena's reader does not parse their keys.
const BY_SERVER: &[&str] = &["localization"];

const PAGE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/guides/arena-reference.md");

#[test]
fn page_matches_the_types() {
    let types = Types::read();
    let written = Page::write(&types, &probe::places(&types));
    if std::env::var_os("UPDATE").is_some() {
        std::fs::write(PAGE, written).unwrap();
        return;
    }
    let committed = std::fs::read_to_string(PAGE).unwrap_or_default();
    let differs = written.lines().zip(committed.lines()).find(|(new, old)| new != old);
    assert!(
        written == committed,
        "docs/guides/arena-reference.md does not match the types, first in {differs:?}; run \
         UPDATE=1 cargo test -p vizflyt-arena --test reference to write it"
    );
}

#[test]
fn serde_accepts_and_requires_the_same_keys() {
    let types = Types::read();
    let places = probe::places(&types);
    let page = Page::write(&types, &places);
    let mut checked = 0;
    for place in places {
        if place.way.first().is_some_and(|step| BY_SERVER.contains(&step.key.as_str())) {
            continue;
        }
        let keys = types.keys(&place.table, place.variant());
        let named: BTreeSet<_> = keys.iter().map(|key| key.name.clone()).collect();
        let known = probe::known_keys(&types, &place);
        assert_eq!(named, known, "of {}", place.name());
        for key in keys.iter().filter(|key| key.required) {
            let file = probe::least_file(&types, &place, &|table| {
                table.remove(&key.name);
            });
            let refusal = probe::read(file).unwrap_err();
            assert!(refusal.contains(&format!("missing field `{}`", key.name)), "{refusal}");
        }
        for key in known {
            assert!(is_on(&page, &types, &place, &key), "the page lacks {}.{key}", place.name());
            checked += 1;
        }
    }
    assert!(checked > 150, "only {checked} keys");
}

/// Whether a key has a row: in its table's section, in that of a top-level table of the same type, or a section
/// for itself.
fn is_on(page: &str, types: &Types, place: &Place, key: &str) -> bool {
    let section = |name: &str| {
        let mut sections = page.split("\n## ").skip(1);
        sections.find(|text| text.lines().next().unwrap().trim_matches(['`', '[', ']']) == name)
    };
    let Some(top) = place.way.first() else {
        return section(key).is_some() || has_row(section("Top-level keys").unwrap(), key);
    };
    let inside: String = place.way[1..].iter().flat_map(|step| [step.key.as_str(), "."]).collect();
    let same = types
        .keys("ArenaConfig", None)
        .iter()
        .find(|top| types.table_of(&top.kind).is_some_and(|(table, _)| table == place.table));
    has_row(section(&top.key).unwrap(), &format!("{inside}{key}"))
        || same.is_some_and(|same| has_row(section(&same.name).unwrap(), key))
}

fn has_row(section: &str, key: &str) -> bool {
    let first_cells =
        section.lines().filter_map(|line| line.strip_prefix("| ")?.split(" | ").next());
    first_cells.into_iter().any(|cell| cell.contains(&format!("`{key}`")))
}

#[test]
fn examples_are_a_valid_arena() {
    let arena = ArenaConfig::parse(EXAMPLE).unwrap();
    assert_eq!(ArenaConfig::parse(&arena.to_toml().unwrap()).unwrap(), arena);
    // `# key = value   # in place of a and b`
    let mut alternatives = 0;
    for (_, section) in sections(EXAMPLE) {
        for line in section.lines() {
            let Some((setting, instead)) =
                line.strip_prefix("# ").and_then(|line| line.split_once("# in place of "))
            else {
                continue;
            };
            let given = section.lines().filter(|line| {
                let key = line.split(" = ").next().unwrap();
                !instead.split(" and ").any(|other| other == key)
            });
            let given = given.map(|other| if other == line { setting } else { other });
            let other = EXAMPLE.replace(&section, &given.collect::<Vec<_>>().join("\n"));
            assert_ne!(ArenaConfig::parse(&other).unwrap(), arena, "{setting}");
            alternatives += 1;
        }
    }
    assert!(alternatives > 0);
}

#[test]
fn server_has_the_keys_of_its_examples() {
    let types = Types::read();
    let example: Table = EXAMPLE.parse().unwrap();
    for name in BY_SERVER {
        let top = types.keys("ArenaConfig", None).iter().find(|key| key.name == *name).unwrap();
        let (table, _) = types.table_of(&top.kind).unwrap();
        for given in example[*name].as_array().unwrap() {
            has_keys(&types, table, given.as_table().unwrap());
        }
    }
}

fn has_keys(types: &Types, table: &str, given: &Table) {
    for key in types.keys(table, None) {
        assert!(!key.required || given.contains_key(&key.name), "{table}.{} is absent", key.name);
    }
    for (name, value) in given {
        let mut keys = types.keys(table, None).iter();
        let key = keys.find(|key| key.name == *name);
        let key = key.unwrap_or_else(|| panic!("{table} has no {name}"));
        match (&key.kind, value) {
            (Kind::Named(inner), Value::Table(value)) => has_keys(types, inner, value),
            (Kind::Named(inner), Value::String(word)) => {
                let Shape::Word(words) = &types.get(inner).shape else { panic!("{name} = {word}") };
                assert!(
                    words.is_empty() || words.iter().any(|known| known.name == *word),
                    "{word}"
                );
            }
            _ => {}
        }
    }
}

#[test]
fn words_match_the_code() {
    let types = Types::read();
    let Shape::Word(words) = &types.get("Up").shape else { panic!("up is a word") };
    let said: Vec<_> = words.iter().map(|word| word.name.as_str()).collect();
    assert_eq!(said, Up::ALL.map(Up::name));
}
