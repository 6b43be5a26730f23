//! Line number of a key in an `arena.toml`.

use toml::Spanned;
use toml::de::{DeTable, DeValue};

/// Returns the line, from 1, of a key such as `stages[1].width_m`. If the file does not contain the key,
/// returns the line of the nearest key above it. Returns `None` for invalid TOML, and if no part of the key is
/// in the file.
///
/// ```
/// use vizflyt_arena::config::line_of;
/// let text = "name = \"room\"\n[[stages]]\nname = \"gap\"\n[[stages]]\nname = \"door\"\n";
/// assert_eq!(line_of(text, "stages[1].name"), Some(5));
/// assert_eq!(line_of(text, "stages[1].width_m"), Some(4));
/// assert_eq!(line_of(text, "goal.radius_m"), None);
/// ```
pub fn line_of(text: &str, key: &str) -> Option<usize> {
    let table = DeTable::parse(text).ok()?;
    let mut found = None;
    let mut inside = Some(Inside::Table(table.get_ref()));
    // `stages[1].width_m` has the steps stages, 1, width_m.
    for step in key.split(['.', '[', ']']).filter(|step| !step.is_empty()) {
        let next = match inside? {
            Inside::Table(table) => {
                let entry = table.iter().find(|(name, _)| name.get_ref().as_ref() == step);
                entry.map(|(name, value)| (name.span().start, value))
            }
            Inside::Array(array) => {
                let index: Option<usize> = step.parse().ok();
                let value = index.and_then(|index| array.get(index));
                value.map(|value| (value.span().start, value))
            }
        };
        let Some((start, value)) = next else { break };
        found = Some(start);
        inside = match value.get_ref() {
            DeValue::Table(table) => Some(Inside::Table(table)),
            DeValue::Array(array) => Some(Inside::Array(array)),
            _ => None,
        };
        if inside.is_none() {
            break;
        }
    }
    let start = found?;
    Some(text.get(..start)?.matches('\n').count() + 1)
}

enum Inside<'a, 'i> {
    Table(&'a DeTable<'i>),
    Array(&'a [Spanned<DeValue<'i>>]),
}
