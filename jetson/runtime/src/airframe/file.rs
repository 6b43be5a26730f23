//! Parameter files in the formats of Mission Planner (`NAME,VALUE`), MAVProxy (`NAME VALUE`) and QGroundControl (five
//! columns). `#` starts a comment.

use std::collections::BTreeMap;

/// Error of a parameter file.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ParamFileError {
    /// A line is not a parameter.
    #[error("line {line}: {text:?} is not a parameter; write NAME,VALUE")]
    Line {
        /// Line number, from 1.
        line: usize,
        /// Beginning of the line.
        text: String,
    },
    /// A parameter occurs twice.
    #[error("line {line}: {name} was set before")]
    Twice {
        /// Line number, from 1.
        line: usize,
        /// Name of the parameter.
        name: String,
    },
}

/// Maximum length of a parameter's name (MAVLink, PARAM_VALUE).
const MAX_NAME: usize = 16;
/// Maximum length of a line in an error.
const SHOWN: usize = 40;

/// Returns the parameters of a file.
///
/// # Errors
/// Returns [`ParamFileError`] with the line.
pub fn parse_params(text: &str) -> Result<BTreeMap<String, f64>, ParamFileError> {
    let mut params = BTreeMap::new();
    for (index, full) in text.lines().enumerate() {
        let line = index + 1;
        let content = full.split('#').next().unwrap_or("").trim();
        if content.is_empty() {
            continue;
        }
        let columns: Vec<&str> = content
            .split(|c: char| c == ',' || c.is_whitespace())
            .filter(|column| !column.is_empty())
            .collect();
        let pair = match columns[..] {
            [name, value] | [_, _, name, value, _] => is_name(name)
                .then(|| value.parse::<f64>().ok().filter(|value| value.is_finite()))
                .flatten()
                .map(|value| (name.to_owned(), value)),
            _ => None,
        };
        let Some((name, value)) = pair else {
            let text = full.chars().take(SHOWN).collect();
            return Err(ParamFileError::Line { line, text });
        };
        if params.insert(name.clone(), value).is_some() {
            return Err(ParamFileError::Twice { line, name });
        }
    }
    Ok(params)
}

fn is_name(name: &str) -> bool {
    (1..=MAX_NAME).contains(&name.len())
        && name.bytes().all(|c| c.is_ascii_uppercase() || c.is_ascii_digit() || c == b'_')
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn reads_the_files_of_three_programs() {
        let expected = BTreeMap::from([("A_B".to_owned(), 1.5), ("C1".to_owned(), -2.0)]);
        for text in [
            "A_B,1.5\nC1,-2",
            "# of a lab\nA_B   1.5 # why\n\nC1\t-2.0\n",
            "1 1 A_B 1.5 9\r\n1\t1\tC1\t-2\t6\r\n",
        ] {
            assert_eq!(parse_params(text).unwrap(), expected, "{text}");
        }
    }

    #[test]
    fn errors_contain_the_line() {
        let check = |text: &str, expected: &str| {
            assert_eq!(parse_params(text).unwrap_err().to_string(), expected);
        };
        check("A,1\nB", "line 2: \"B\" is not a parameter; write NAME,VALUE");
        check("A,NaN", "line 1: \"A,NaN\" is not a parameter; write NAME,VALUE");
        check("a,1", "line 1: \"a,1\" is not a parameter; write NAME,VALUE");
        check("A,1\n\nA,2", "line 3: A was set before");
    }

    proptest! {
        #[test]
        fn no_text_panics(text in "[A-Z0-9_,.# \n\t-]{0,200}") {
            for (name, value) in parse_params(&text).unwrap_or_default() {
                prop_assert!(is_name(&name) && value.is_finite());
            }
        }
    }
}
