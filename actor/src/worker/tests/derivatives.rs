//! The simulator's derivative in an unroll.

use super::*;

#[test]
fn an_unroll_has_a_derivative_for_each_transition_or_none() {
    let rows = |derivatives: usize| {
        let shape = UnrollShape { action_gradient: 56, ..*layout(4).shape() };
        let layout = Arc::new(UnrollLayout::new(shape));
        let environment = Counter { derivatives, ..Counter::new(&[2, 9]) };
        let mut worker = Worker::new(vec![environment], Plain::default(), Arc::clone(&layout), 0, 3).unwrap();
        worker.adopt(&directive(0)).unwrap();
        let unrolls = worker.unroll(&|| false, &Progress::default()).map_err(|error| error.to_string())?.unwrap();
        let rows = Rows { layout: &layout, payload: &unrolls[0].payload };
        Ok::<_, String>((0..4).map(|t| rows.one(Field::ActionGradient, t)).collect::<Vec<_>>())
    };
    // Row 2 is the first episode's last observation.
    assert_eq!(rows(3).unwrap(), [1.0, 2.0, 0.0, 3.0]);
    assert_eq!(rows(0).unwrap(), [0.0; 4], "a task without derivatives");
    let error = rows(2).unwrap_err();
    assert!(error.contains("3 transitions") && error.contains("2 derivatives"), "{error}");
}
