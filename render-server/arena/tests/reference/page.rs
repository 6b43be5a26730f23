//! The page: one section per top-level table, in the order of the example.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;

use vizflyt_arena::config::imaging::{DEPTHS, SENSORS};

use super::probe::{self, Place, Step};
use super::source::{Key, Kind, Shape, Types, Variant};
use super::{BY_SERVER, EXAMPLE};

const HEAD: &str = "\
# arena.toml, key by key

<!-- Written by `UPDATE=1 cargo test -p vizflyt-arena --test reference` from the types that read the file. -->

Reference of all keys of `arena.toml`: the room, the course, the vehicle and the rules. For their use, see
[scenes.md](scenes.md) and [course.md](course.md). `vizflyt arena new` writes a first file; `vizflyt arena check` finds
errors. Unknown keys are rejected with their line.

- **Type**: type of the value, and the range of numbers.
- **Unit**: unit of the numbers, and their frame ([COORDINATES.md](../COORDINATES.md)): *world* is the room, z up;
  *body* is the vehicle, x forward, y left, z up.
- **Default**: value if the key is absent. *required*: the key must be present. *none*: the key is optional, and its
  text describes the effect of leaving it out.
- `rain.rate_mmph` is the key `rate_mmph` in `rain = { rate_mmph = 5.0 }`. A `[[table]]` may occur several times.
";

/// Guide with more information for each table.
const GUIDES: &[(&str, &str)] = &[
    ("scene", "scenes.md"),
    ("geofence", "safety.md"),
    ("limits", "safety.md"),
    ("cameras", "cameras.md"),
    ("stages", "course.md"),
    ("goal", "course.md"),
    ("rules", "course.md"),
    ("objects", "course.md"),
    ("no_fly", "safety.md"),
    ("body", "safety.md"),
    ("environment", "weather.md"),
    ("sensors", "sensors.md"),
    ("vehicles", "vehicles.md"),
    ("localization", "localization.md"),
    ("pose", "pose.md"),
];

/// Maximum length of a description that may share a row with others.
const SHORT: usize = 60;

/// Returns the sections of the example: a table's name, empty for top-level keys, and its lines.
pub(crate) fn sections(example: &str) -> Vec<(String, String)> {
    let mut sections = vec![(String::new(), String::new())];
    for line in example.lines() {
        let header = line.strip_prefix('[').and_then(|line| line.split_once(']'));
        if let Some((name, _)) = header {
            let name = name.trim_start_matches('[');
            if sections.last().unwrap().0 != name {
                sections.push((name.to_owned(), String::new()));
            }
        }
        let (_, text) = sections.last_mut().unwrap();
        text.push_str(line);
        text.push('\n');
    }
    for (_, text) in &mut sections {
        text.truncate(text.trim_end().len());
    }
    sections
}

/// Generator of the page.
pub(crate) struct Page<'a> {
    types: &'a Types,
    ranges: BTreeMap<String, String>,
    text: String,
}

impl<'a> Page<'a> {
    pub(crate) fn write(types: &'a Types, places: &[Place]) -> String {
        let ranges = probe::ranges(types, places, EXAMPLE);
        let mut page = Self { types, ranges, text: HEAD.to_owned() };
        let sections = sections(EXAMPLE);
        let links = sections.iter().skip(1).map(|(name, _)| format!("[{name}](#{name})"));
        let links = format!("Tables: {}.", links.collect::<Vec<_>>().join(", "));
        write!(page.text, "\n{}\n", wrapped(&links)).unwrap();
        for (name, example) in &sections {
            page.section(name, example);
        }
        let at_top = types.keys("ArenaConfig", None).iter();
        let tables = at_top.filter(|key| types.table_of(&key.kind).is_some());
        let shown: BTreeSet<_> = sections.iter().map(|(name, _)| name.as_str()).collect();
        for table in tables {
            assert!(shown.contains(table.name.as_str()), "the example lacks [{}]", table.name);
        }
        page.text
    }

    /// Returns the header of a top-level table: `[goal]`, `[[stages]]`.
    fn header(&self, name: &str) -> String {
        let key = self.top(name);
        let (_, list) = self.types.table_of(&key.kind).unwrap();
        if list { format!("[[{name}]]") } else { format!("[{name}]") }
    }

    fn top(&self, name: &str) -> &'a Key {
        let mut keys = self.types.keys("ArenaConfig", None).iter();
        keys.find(|key| key.name == name).unwrap_or_else(|| panic!("[{name}] is not a table"))
    }

    fn section(&mut self, name: &str, example: &str) {
        let mut place = Place { way: Vec::new(), table: "ArenaConfig".to_owned() };
        if name.is_empty() {
            self.text.push_str("\n## Top-level keys\n");
        } else {
            let key = self.top(name);
            let (table, list) = self.types.table_of(&key.kind).unwrap();
            let mut said = vec![linked_to_names(&key.doc)];
            // A single table is described by its key; a list also by its type.
            said.extend(list.then(|| linked_to_names(&each(&self.types.get(table).doc))));
            said.extend(key.required.then(|| "Required.".to_owned()));
            let guide = GUIDES.iter().find(|(known, _)| *known == name);
            said.extend(guide.map(|(_, guide)| format!("More in [{guide}]({guide}).")));
            said.retain(|sentence| !sentence.is_empty());
            let said = wrapped(&said.join(" "));
            write!(self.text, "\n## `{}`\n\n{said}\n", self.header(name)).unwrap();
            place = Place {
                way: vec![Step { key: name.to_owned(), list, variant: None }],
                table: table.to_owned(),
            };
        }
        self.text.push_str("\n| key | type | unit | default | meaning |\n|---|---|---|---|---|\n");
        self.rows(&place, "", "");
        write!(self.text, "\n```toml\n{example}\n```\n").unwrap();
    }

    /// Writes the rows of a table, and of tables inside it.
    fn rows(&mut self, place: &Place, prefix: &str, of: &str) {
        let types = self.types;
        let by_server =
            place.way.first().is_some_and(|step| BY_SERVER.contains(&step.key.as_str()));
        let defaults = if by_server { BTreeMap::new() } else { probe::defaults(types, place) };
        let mut last: Option<Row> = None;
        for key in types.keys(&place.table, place.variant()) {
            let inner = types.table_of(&key.kind);
            if place.way.is_empty() && inner.is_some() {
                continue;
            }
            let default = match defaults.get(&key.name) {
                _ if key.required => "required".to_owned(),
                Some(Some(value)) => format!("`{value}`"),
                None if key.default.is_some() => format!("`{}`", key.default.as_ref().unwrap()),
                _ => "none".to_owned(),
            };
            let name = format!("{prefix}{}", key.name);
            let range = self.ranges.get(&format!("{}.{}", place.name(), key.name));
            let range = range.map_or_else(String::new, |range| format!(", {range}"));
            let kind = format!("{}{range}", self.kind(&key.kind));
            let said = self.said(key);
            let name = format!("`{name}`");
            let row = Row { names: name, cells: [kind, key.unit.clone(), default], said };
            match &mut last {
                Some(last) if last.takes(&row) => last.take(&row),
                _ => {
                    let before = last.replace(row);
                    self.text.extend(before.map(|before| before.text(of)));
                }
            }
            if let Some((table, list)) = inner
                && self.home(table).is_none()
            {
                self.text.extend(last.take().map(|row| row.text(of)));
                let step = |variant| Step { key: key.name.clone(), list, variant };
                self.inner(place, table, &format!("{prefix}{}.", key.name), &step);
            }
        }
        self.text.extend(last.map(|row| row.text(of)));
    }

    fn inner(
        &mut self,
        place: &Place,
        table: &str,
        prefix: &str,
        step: &dyn Fn(Option<String>) -> Step,
    ) {
        let below = |variant| Place {
            way: [place.way.clone(), vec![step(variant)]].concat(),
            table: table.to_owned(),
        };
        match &self.types.get(table).shape {
            Shape::Tagged { tag, variants } => {
                let words = words(variants);
                writeln!(self.text, "| `{prefix}{tag}` | word | | required | {words} |").unwrap();
                for variant in variants {
                    let of = format!(" of `{}`", variant.name);
                    self.rows(&below(Some(variant.name.clone())), prefix, &of);
                }
            }
            _ => self.rows(&below(None), prefix, ""),
        }
    }

    /// Returns the top-level table of the same type, if there is one.
    fn home(&self, table: &str) -> Option<&'a str> {
        let mut keys = self.types.keys("ArenaConfig", None).iter();
        let same =
            |key: &&Key| self.types.table_of(&key.kind).is_some_and(|(name, _)| name == table);
        keys.find(same).map(|key| key.name.as_str())
    }

    fn kind(&self, kind: &Kind) -> String {
        match self.types.kind_of(kind) {
            Kind::Number => "number".to_owned(),
            Kind::Integer => "integer".to_owned(),
            Kind::Flag => "`true`, `false`".to_owned(),
            Kind::Text => "text".to_owned(),
            Kind::Vector(2) => "`[x, y]`".to_owned(),
            Kind::Vector(_) => "`[x, y, z]`".to_owned(),
            Kind::Numbers(count) => format!("{count} numbers"),
            Kind::List(inner) => format!("list of {}", self.kind(inner)),
            Kind::Free => "table".to_owned(),
            Kind::Named(name) => match &self.types.get(name).shape {
                Shape::Word(_) => "word".to_owned(),
                _ => match self.home(name) {
                    Some(home) => format!("table, as [`{}`](#{home})", self.header(home)),
                    None => "table".to_owned(),
                },
            },
        }
    }

    /// Returns the description of a key, with the words that it may contain.
    fn said(&self, key: &Key) -> String {
        let mut kind = self.types.kind_of(&key.kind);
        while let Kind::List(inner) = kind {
            kind = self.types.kind_of(inner);
        }
        let said = linked_to_names(&key.doc);
        let Kind::Named(name) = kind else { return said };
        let described = self.types.get(name);
        match &described.shape {
            Shape::Word(variants) if variants.is_empty() => {
                format!("{said} {}", linked_to_names(&described.doc))
            }
            Shape::Word(variants) => format!("{said} {}", words(variants)),
            _ => said,
        }
    }
}

/// A row of the table of keys.
struct Row {
    names: String,
    cells: [String; 3],
    said: String,
}

impl Row {
    /// Whether another key fits into the row: all cells are equal, except short descriptions.
    fn takes(&self, other: &Self) -> bool {
        let short = |said: &str| said.len() < SHORT && said.ends_with('.') && !said.contains(';');
        let last = self.said.rsplit_once("; ").map_or(self.said.as_str(), |(_, last)| last);
        self.cells == other.cells && self.cells[2] != "`true`" && short(last) && short(&other.said)
    }

    fn take(&mut self, other: &Self) {
        self.names = format!("{}, {}", self.names, other.names);
        self.said = format!("{}; {}", self.said.trim_end_matches('.'), in_sentence(&other.said));
    }

    fn text(self, of: &str) -> String {
        let [kind, unit, default] = self.cells;
        let cells = [self.names + of, kind, unit, default, self.said];
        let cells = cells.iter().map(|cell| format!(" {cell} ").replace("  ", " "));
        format!("|{}|\n", cells.collect::<Vec<_>>().join("|"))
    }
}

/// Returns words with their meanings.
fn words(variants: &[Variant]) -> String {
    let word = |variant: &Variant| {
        format!("`{}`: {}", variant.name, linked_to_names(variant.doc.trim_end_matches('.')))
    };
    variants.iter().map(word).collect::<Vec<_>>().join("; ") + "."
}

/// Returns the description of each table in a list, without the list's name, which is in the header.
fn each(doc: &str) -> String {
    let said = doc.strip_prefix('`').and_then(|doc| doc.split_once("`: ")).map(|(_, said)| said);
    let says_more = |said: &&str| !said.starts_with("one ");
    let mut letters = said.filter(says_more).unwrap_or_default().chars();
    letters.next().into_iter().flat_map(char::to_uppercase).chain(letters).collect()
}

/// Returns a sentence in the form after a semicolon.
fn in_sentence(said: &str) -> String {
    let mut letters = said.chars();
    letters.next().into_iter().flat_map(char::to_lowercase).chain(letters).collect()
}

/// Returns text in lines of at most 130 characters.
fn wrapped(text: &str) -> String {
    let mut lines = vec![String::new()];
    for word in text.split(' ') {
        let line = lines.last_mut().unwrap();
        if line.is_empty() {
            line.push_str(word);
        } else if line.len() + word.len() < 130 {
            line.push(' ');
            line.push_str(word);
        } else {
            lines.push(word.to_owned());
        }
    }
    lines.join("\n")
}

/// Returns a doc comment with links into the code replaced by names.
fn linked_to_names(doc: &str) -> String {
    let names = |names: Vec<&str>| {
        names.iter().map(|name| format!("`{name}`")).collect::<Vec<_>>().join(", ")
    };
    let doc = doc
        .replace("[`SENSORS`]", &names(SENSORS.iter().map(|(name, _)| *name).collect()))
        .replace("[`DEPTHS`]", &names(DEPTHS.iter().map(|(name, _)| *name).collect()));
    assert!(!doc.contains("[`"), "a page cannot contain a link into the code: {doc}");
    doc.replace('|', "\\|")
}
