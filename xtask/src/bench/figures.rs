//! What was measured, by name.

use std::collections::BTreeMap;

use anyhow::{Context, Result};

/// Figures: where or how it was measured, of what, and what.
#[derive(Debug, Default)]
pub(crate) struct Figures(BTreeMap<(String, String, String), f64>);

impl Figures {
    /// Notes a figure.
    pub(crate) fn set(&mut self, place: &str, subject: &str, what: &str, figure: f64) {
        self.0.insert((place.to_owned(), subject.to_owned(), what.to_owned()), figure);
    }

    /// A figure.
    ///
    /// # Errors
    /// Where it was not measured: no limit is met by that.
    pub(crate) fn get(&self, place: &str, subject: &str, what: &str) -> Result<f64> {
        let name = (place.to_owned(), subject.to_owned(), what.to_owned());
        self.0.get(&name).copied().with_context(|| format!("{place}, {subject}: {what} was not measured"))
    }

    /// Takes the lines that a program of the benchmark prints, `subject<TAB>what<TAB>figure` each.
    pub(crate) fn read(&mut self, place: &str, printed: &str) -> Result<()> {
        for line in printed.lines() {
            let mut words = line.split('\t');
            let (Some(subject), Some(what), Some(figure)) = (words.next(), words.next(), words.next()) else {
                continue;
            };
            let figure = figure.parse().with_context(|| format!("`{line}` ends with no figure"))?;
            self.set(place, subject, what, figure);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_with_three_columns_are_figures() {
        let mut figures = Figures::default();
        figures.read("here", "some words\na\tb c\t12.5\n").unwrap();
        assert_eq!(figures.get("here", "a", "b c").unwrap(), 12.5);
        assert!(figures.get("here", "a", "b").is_err());
        assert!(figures.read("here", "a\tb\tc\n").is_err());
    }
}
