//! Prints rows as a table.

/// Aligns the columns: the first and the last to the left, the others to the right.
pub(super) fn table<const N: usize>(header: [&str; N], rows: &[[String; N]]) -> String {
    let header = header.map(String::from);
    let all = || std::iter::once(&header).chain(rows);
    let widths: [usize; N] =
        std::array::from_fn(|column| all().map(|row| row[column].chars().count()).max().unwrap_or(0));
    let mut text = String::new();
    for row in all() {
        let mut line = String::new();
        for (column, (cell, width)) in row.iter().zip(widths).enumerate() {
            let cell = match column {
                0 => format!("{cell:<width$}"),
                column if column + 1 == N => cell.clone(),
                _ => format!("{cell:>width$}"),
            };
            line += &cell;
            line += "  ";
        }
        text += line.trim_end();
        text.push('\n');
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_stand_left_numbers_right_and_words_last() {
        let rows = [["walk", "87", "a, b"], ["a-long-name", "5", ""]].map(|row| row.map(String::from));
        let expected = "clip         frames  in\nwalk             87  a, b\na-long-name       5\n";
        assert_eq!(table(["clip", "frames", "in"], &rows), expected);
    }
}
