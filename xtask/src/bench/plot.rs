//! Bars, as SVG.

use std::fmt::Write as _;

/// Bars of one colour: what they are called, and how long each is; nothing where it was not measured.
pub(crate) struct Series {
    pub(crate) name: String,
    pub(crate) values: Vec<Option<f64>>,
}

const COLOURS: [&str; 5] = ["#1b6ca8", "#e07b39", "#5a9367", "#8d6a9f", "#767676"];
const BAR: usize = 14;
const LEFT: usize = 190;
const WIDTH: f64 = 520.0;
const TOP: usize = 60;

/// Horizontal bars: a group for each name, a colour for each series.
pub(crate) fn bars(title: &str, groups: &[&str], series: &[Series]) -> String {
    let longest = series
        .iter()
        .flat_map(|one| one.values.iter().flatten())
        .fold(1.0, |most: f64, value| most.max(*value));
    let height = series.len() * BAR + BAR;
    let mut svg = String::new();
    // writing to a string cannot fail
    let _ = writeln!(
        svg,
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"800\" height=\"{}\" font-family=\"sans-serif\" \
         font-size=\"12\">\n<rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n\
         <text x=\"10\" y=\"20\" font-size=\"15\">{title}</text>",
        TOP + groups.len() * height
    );
    for (index, one) in series.iter().enumerate() {
        let (x, colour) = (LEFT + 150 * index, COLOURS[index % COLOURS.len()]);
        let _ = writeln!(
            svg,
            "<rect x=\"{x}\" y=\"32\" width=\"10\" height=\"10\" fill=\"{colour}\"/><text x=\"{}\" y=\"41\">{}</text>",
            x + 14,
            one.name
        );
    }
    for (group, name) in groups.iter().enumerate() {
        let y = TOP + group * height;
        let middle = y + series.len() * BAR / 2 + 4;
        let _ = writeln!(svg, "<text x=\"{}\" y=\"{middle}\" text-anchor=\"end\">{name}</text>", LEFT - 8);
        for (index, one) in series.iter().enumerate() {
            let Some(value) = one.values.get(group).copied().flatten() else { continue };
            let (y, length) = (y + index * BAR, WIDTH * value / longest);
            let _ = writeln!(
                svg,
                "<rect x=\"{LEFT}\" y=\"{y}\" width=\"{length:.1}\" height=\"{}\" fill=\"{}\"/>\
                 <text x=\"{:.1}\" y=\"{}\" font-size=\"11\">{value}</text>",
                BAR - 2,
                COLOURS[index % COLOURS.len()],
                LEFT as f64 + length + 4.0,
                y + BAR - 4
            );
        }
    }
    svg.push_str("</svg>\n");
    svg
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_longest_bar_has_the_whole_width() {
        let series = Series { name: "a".into(), values: vec![Some(5.0), None, Some(10.0)] };
        let svg = bars("title", &["x", "y", "z"], &[series]);
        assert!(svg.contains("width=\"520.0\"") && svg.contains("width=\"260.0\""), "{svg}");
        assert_eq!(svg.matches("font-size=\"11\"").count(), 2, "what was not measured has no bar");
    }
}
