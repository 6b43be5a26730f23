//! Finds and edits an existing arena.toml. All text that is not changed stays, including comments.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};
use serde::Serialize;
use serde::de::DeserializeOwned;
use toml_edit::{
    Array, ArrayOfTables, DocumentMut, InlineTable, Item, Table, TableLike, Value, value,
};
use vizflyt_arena::ArenaConfig;

/// Returns the path of an arena.toml, given the file or its folder.
///
/// # Errors
/// The file does not exist.
pub(crate) fn find(arena: &Path) -> Result<PathBuf> {
    let path = if arena.is_dir() { arena.join("arena.toml") } else { arena.to_owned() };
    ensure!(
        path.extension().is_some_and(|extension| extension == "toml") && path.is_file(),
        "{} is not an arena; create one for the scene: vizflyt arena new FOLDER --scene {}",
        arena.display(),
        arena.display()
    );
    Ok(path)
}

/// Edits the file of an arena.
///
/// # Errors
/// The file cannot be read or written, or the arena would be invalid. In this case, nothing is written.
pub(crate) fn change(
    path: &Path,
    change: impl FnOnce(&mut DocumentMut) -> Result<()>,
) -> Result<()> {
    let text =
        std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    let mut document: DocumentMut =
        text.parse().with_context(|| format!("{} is not valid TOML", path.display()))?;
    change(&mut document)?;
    let changed = document.to_string();
    ArenaConfig::parse(&changed).with_context(|| {
        format!("nothing is written, because {} would become invalid", path.display())
    })?;
    std::fs::write(path, changed).with_context(|| format!("cannot write {}", path.display()))
}

/// Returns a table of the document.
pub(crate) fn table<'a>(document: &'a mut DocumentMut, key: &str) -> Result<&'a mut dyn TableLike> {
    let item = document.get_mut(key).and_then(Item::as_table_like_mut);
    item.with_context(|| format!("{key} is not a table"))
}

/// Sets a key. Comments and spaces around an old value stay.
pub(crate) fn set(table: &mut dyn TableLike, key: &str, mut new: Value) {
    if let Some(old) = table.get(key).and_then(Item::as_value) {
        if is_same(old, &new) {
            return;
        }
        *new.decor_mut() = old.decor().clone();
    }
    table.insert(key, Item::Value(new));
}

/// Returns an array of numbers.
pub(crate) fn numbers(of: &[f64]) -> Value {
    Value::Array(of.iter().copied().collect::<Array>())
}

/// Writes a table of the document's root, and creates it if it is missing.
pub(crate) fn put(document: &mut DocumentMut, key: &str, new: &impl Serialize) -> Result<()> {
    let new = written(new)?;
    if document.contains_key(key) {
        merge(table(document, key)?, &new);
    } else {
        document.insert(key, Item::Table(new));
    }
    Ok(())
}

/// Writes a list of named tables. Tables with an existing name keep their comments. Tables with unchanged values keep
/// their exact text.
pub(crate) fn put_list<T>(document: &mut DocumentMut, key: &str, new: &[T]) -> Result<()>
where
    T: Serialize + DeserializeOwned + PartialEq,
{
    if new.is_empty() {
        document.remove(key);
        return Ok(());
    }
    let old = match document.get(key) {
        None => Vec::new(),
        Some(Item::ArrayOfTables(old)) => old.iter().cloned().collect(),
        Some(item) => {
            let array =
                item.as_array().with_context(|| format!("{key} is not a list of tables"))?;
            let inline = array.iter().filter_map(Value::as_inline_table);
            inline.cloned().map(InlineTable::into_table).collect()
        }
    };
    let mut tables = Vec::new();
    for item in new {
        let mut table = written(item)?;
        let has_name = |old: &&Table| name(old).is_some() && name(old) == name(&table);
        if let Some(old) = old.iter().find(has_name) {
            let mut kept = old.clone();
            let says = toml::from_str::<T>(&old.to_string());
            if says.ok().as_ref() != Some(item) {
                merge(&mut kept, &table);
            }
            table = kept;
        }
        tables.push(table);
    }
    if let Some(array) = document.get_mut(key).and_then(Item::as_array_mut) {
        // One line for each table.
        array.clear();
        for table in tables {
            let mut inline = Value::InlineTable(table.into_inline_table());
            inline.decor_mut().set_prefix("\n    ");
            array.push_formatted(inline);
        }
        array.set_trailing("\n");
        array.set_trailing_comma(true);
        return Ok(());
    }
    document.insert(key, Item::ArrayOfTables(tables.into_iter().collect::<ArrayOfTables>()));
    Ok(())
}

fn name(table: &Table) -> Option<&str> {
    table.get("name")?.as_str()
}

/// Serializes a value as a table, with inner tables as inline values.
fn written(of: &impl Serialize) -> Result<Table> {
    let document: DocumentMut = toml::to_string(of)?.parse()?;
    let mut table = Table::new();
    for (key, item) in document.as_table() {
        let item = item.clone().into_value().map_or(Item::None, value);
        table.insert(key, item);
    }
    Ok(table)
}

/// Gives an old table the values of a new one, and keeps its comments.
fn merge(old: &mut dyn TableLike, new: &Table) {
    let gone: Vec<String> =
        old.iter().map(|(key, _)| key.to_owned()).filter(|key| !new.contains_key(key)).collect();
    for key in gone {
        old.remove(&key);
    }
    for (key, item) in new {
        if let Some(value) = item.as_value() {
            let inner = old.get_mut(key).and_then(Item::as_table_like_mut);
            match (inner, value) {
                (Some(inner), Value::InlineTable(new)) => merge(inner, &new.clone().into_table()),
                _ => set(old, key, value.clone()),
            }
        }
    }
}

/// Whether two values are equal; 1 equals 1.0.
fn is_same(a: &Value, b: &Value) -> bool {
    let number = |value: &Value| match value {
        Value::Integer(n) => Some(*n.value() as f64),
        Value::Float(n) => Some(*n.value()),
        _ => None,
    };
    match (a, b) {
        (Value::Array(a), Value::Array(b)) => {
            a.len() == b.len() && a.iter().zip(b).all(|(a, b)| is_same(a, b))
        }
        (Value::String(a), Value::String(b)) => a.value() == b.value(),
        (Value::Boolean(a), Value::Boolean(b)) => a.value() == b.value(),
        _ => number(a).is_some() && number(a) == number(b),
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use vizflyt_arena::config::{Goal, StageConfig};

    use super::*;

    const TEXT: &str = "\
# A course for Tuesday.
name = \"hall\" # the small one
goal = { position_m = [9, 0, 1], radius_m = 0.5 } # by the door

# The one with the blue tape.
[[stages]]
name = \"first\" # keep
center_m = [3, 0, 1.2]   # measured
normal = [1, 0, 0]
width_m = 1.2
height_m = 1
clearance_m = 0.0 # none yet

[[stages]]
name = \"second\"
center_m = [6, 0, 1]
normal = [1, 0, 0]
width_m = 1
height_m = 1

# Last.
[limits]
max_speed_mps = 2.0
";

    fn stage(name: &str, x_m: f64) -> StageConfig {
        StageConfig {
            name: name.into(),
            center_m: DVec3::new(x_m, 0.0, 1.2),
            normal: DVec3::X,
            width_m: 1.2,
            height_m: 1.0,
            ..StageConfig::default()
        }
    }

    fn with_stages(text: &str, stages: &[StageConfig]) -> String {
        let mut document: DocumentMut = text.parse().unwrap();
        put_list(&mut document, "stages", stages).unwrap();
        document.to_string()
    }

    #[test]
    fn unchanged_tables_keep_their_exact_text() {
        let second = StageConfig {
            center_m: DVec3::new(6.0, 0.0, 1.0),
            width_m: 1.0,
            ..stage("second", 0.0)
        };
        assert_eq!(with_stages(TEXT, &[stage("first", 3.0), second]), TEXT);
    }

    #[test]
    fn moves_adds_and_removes_gates() {
        let changed = with_stages(TEXT, &[stage("first", 3.5), stage("third", 8.0)]);
        for kept in [
            "# A course",
            "# the small one",
            "# The one with the blue",
            "# keep",
            "# measured",
            "# Last.",
        ] {
            assert!(changed.contains(kept), "{kept} is gone:\n{changed}");
        }
        assert!(changed.contains("center_m = [3.5, 0.0, 1.2]   # measured"), "{changed}");
        assert!(!changed.contains("second"), "{changed}");
        let read: DocumentMut = changed.parse().unwrap();
        assert_eq!(read["stages"][1]["name"].as_str(), Some("third"));
        assert_eq!(read["limits"]["max_speed_mps"].as_float(), Some(2.0));
        assert!(!with_stages(TEXT, &[]).contains("stages"));
    }

    #[test]
    fn inline_lists_stay_inline() {
        let text = "a = 1\nstages = [\n    { name = \"one\", center_m = [1, 0, 1], normal = [1, 0, 0], width_m = 1, height_m = 1 },\n]\n[b]\nc = 2\n";
        let changed = with_stages(text, &[stage("one", 2.0), stage("two", 4.0)]);
        let read: DocumentMut = changed.parse().unwrap();
        assert_eq!(read["stages"].as_array().map(Array::len), Some(2), "{changed}");
        assert_eq!(read["b"]["c"].as_integer(), Some(2), "{changed}");
        assert!(with_stages("a = 1\n[b]\nc = 2\n", &[stage("one", 2.0)]).contains("[[stages]]"));
    }

    #[test]
    fn changes_a_table_in_place() {
        let mut document: DocumentMut = TEXT.parse().unwrap();
        let goal = Goal { position_m: DVec3::new(8.0, 0.0, 1.0), radius_m: 0.5 };
        put(&mut document, "goal", &goal).unwrap();
        let changed = document.to_string();
        assert!(
            changed
                .contains("goal = { position_m = [8.0, 0.0, 1.0], radius_m = 0.5 } # by the door"),
            "{changed}"
        );
    }
}
