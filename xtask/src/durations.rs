//! How long the parts of `cargo xtask test` took, and which tests took most of it.

use std::collections::BTreeMap;
use std::fmt;
use std::time::Instant;

/// The programs of tests that have a line of their own.
const MOST_LINES: usize = 9;

/// Seconds of each part, in order.
#[derive(Default)]
pub(crate) struct Durations {
    parts: Vec<(f64, &'static str)>,
    /// The sum of a program's tests, the longest first.
    tests: Vec<(f64, String)>,
}

impl Durations {
    /// Does a part and notes how long it takes, whether it succeeds or not.
    pub(crate) fn of<T>(&mut self, part: &'static str, work: impl FnOnce() -> T) -> T {
        let begun = Instant::now();
        let result = work();
        self.parts.push((begun.elapsed().as_secs_f64(), part));
        result
    }

    /// Reads the report in JUnit's format that cargo-nextest wrote.
    pub(crate) fn read_tests(&mut self, report: &str) {
        let mut sums = BTreeMap::<&str, f64>::new();
        for test in report.lines().filter_map(|line| line.trim_start().strip_prefix("<testcase")) {
            if let (Some(program), Some(Ok(seconds))) =
                (value(test, "classname"), value(test, "time").map(str::parse::<f64>))
            {
                *sums.entry(program).or_default() += seconds;
            }
        }
        self.tests = sums.into_iter().map(|(program, seconds)| (seconds, program.to_owned())).collect();
        self.tests.sort_by(|a, b| b.0.total_cmp(&a.0));
    }
}

/// `.ci/run` prints the lines that begin with TOOK once more.
impl fmt::Display for Durations {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut line = |seconds: f64, what: &str| writeln!(f, "TOOK {seconds:6.0} s: {what}");
        self.parts.iter().try_for_each(|(seconds, part)| line(*seconds, part))?;
        let (long, others) = self.tests.split_at(self.tests.len().min(MOST_LINES));
        long.iter().try_for_each(|(seconds, program)| line(*seconds, &format!("tests of {program}")))?;
        if !others.is_empty() {
            let sum = others.iter().map(|(seconds, _)| seconds).sum();
            line(sum, &format!("tests of {} other programs", others.len()))?;
        }
        Ok(())
    }
}

/// The value of an XML attribute.
fn value<'a>(tag: &'a str, attribute: &str) -> Option<&'a str> {
    let (_, rest) = tag.split_once(&format!(" {attribute}=\""))?;
    rest.split('"').next()
}

#[cfg(test)]
mod tests {
    use super::*;

    const REPORT: &str = r#"<?xml version="1.0" encoding="UTF-8"?>
<testsuites name="nextest-run" tests="4" skipped="0" failures="1" errors="0" timestamp="2026-11-25T13:50:47Z" time="7.250">
    <testsuite name="comic-tests::trace" tests="1" skipped="0" errors="0" failures="0">
        <testcase name="a" classname="comic-tests::trace" timestamp="2026-11-25T13:50:47Z" time="1.000"/>
    </testsuite>
    <testsuite name="comic-tests::lockstep" tests="2" skipped="0" errors="0" failures="1">
        <testcase name="b" classname="comic-tests::lockstep" timestamp="2026-11-25T13:50:47Z" time="2.500">
            <failure type="test failure">&lt;testcase time="9"</failure>
        </testcase>
        <testcase name="c" classname="comic-tests::lockstep" timestamp="2026-11-25T13:50:47Z" time="3.500"/>
    </testsuite>
</testsuites>
"#;

    #[test]
    fn the_programs_with_the_longest_tests_come_first() {
        let mut durations = Durations { parts: vec![(2.0, "set-up"), (20.0, "tests")], tests: Vec::new() };
        durations.read_tests(REPORT);
        assert_eq!(
            durations.to_string(),
            "TOOK      2 s: set-up\nTOOK     20 s: tests\n\
             TOOK      6 s: tests of comic-tests::lockstep\nTOOK      1 s: tests of comic-tests::trace\n"
        );
    }

    #[test]
    fn programs_beyond_the_first_ones_share_a_line() {
        let tests = (0..12).map(|number| (f64::from(20 - number), format!("program-{number}"))).collect();
        let shown = Durations { parts: Vec::new(), tests }.to_string();
        assert_eq!(shown.lines().count(), MOST_LINES + 1);
        assert_eq!(shown.lines().last(), Some("TOOK     30 s: tests of 3 other programs"));
    }
}
