//! Derivatives and solutions.

use proptest::prelude::*;

use super::*;
use crate::body::body;
use crate::spatial::{IDENTITY, matrix};

fn joints() -> impl Strategy<Value = [f64; 56]> {
    prop::collection::vec(0.0..1.0f64, 56).prop_map(|shares| {
        std::array::from_fn(|joint| {
            let [low, high] = JOINT_RANGES[joint];
            low + shares[joint] * (high - low)
        })
    })
}

fn turn() -> impl Strategy<Value = Quaternion> {
    prop::array::uniform4(-1.0..1.0f64).prop_filter("not too short", |q| norm(q) > 0.1).prop_map(normalize)
}

fn pose() -> impl Strategy<Value = Pose> {
    (prop::array::uniform3(-2.0..2.0f64), turn(), joints()).prop_map(|(position, quaternion, joints)| Pose {
        position,
        quaternion,
        joints,
    })
}

/// The orientations of all bodies of a pose and the places of some.
fn goal(wanted: &Pose) -> Goal {
    let frames = wanted.frames();
    let turn = |body: usize| Turn { body, rotation: frames.rotation[body], weights: [0.3, 1.0, 0.2] };
    let reach = |body: usize, from: Option<usize>| {
        let origin = from.map(|from| frames.position[from]).unwrap_or_default();
        Reach { body, from, place: subtract(frames.position[body], origin), weight: 7.0 }
    };
    let reaches = vec![
        reach(ROOT, None),
        reach(body("ltoes"), None),
        reach(body("rhand"), Some(body("rhumerus"))),
        reach(body("lhand"), Some(body("thorax"))),
    ];
    Goal { turns: (ROOT..BODIES).map(turn).collect(), reaches, near: ([0.1; 56], 0.01) }
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, cases: 64, ..Default::default() })]

    #[test]
    fn the_gradient_equals_finite_differences(at in pose(), wanted in pose()) {
        let (solver, goal) = (Solver::new(&[], 0.02), goal(&wanted));
        // Away from the limits, which would cut the differences.
        let at = Pose { joints: std::array::from_fn(|joint| {
            let [low, high] = JOINT_RANGES[joint];
            at.joints[joint].clamp(low + 1e-4, high - 1e-4)
        }), ..at };
        let local = solver.local(&at, &goal);
        for unknown in 0..UNKNOWNS {
            let value = |by: f64| {
                let mut step = [0.0; UNKNOWNS];
                step[unknown] = by;
                let moved = solver.moved(&at, &step);
                solver.value(&moved.frames(), &moved, &goal)
            };
            let slope = (value(1e-5) - value(-1e-5)) / 2e-5;
            let gradient = local.gradient[unknown];
            prop_assert!((gradient - slope).abs() < 1e-5 * (1.0 + slope.abs()), "{unknown}: {gradient}, {slope}");
        }
    }

    /// The Gauss-Newton matrix is the sum of the squares of the residuals' derivatives.
    #[test]
    fn the_matrix_equals_that_of_finite_differences(at in pose(), wanted in pose(), seed in 0u64..1000) {
        let (solver, goal) = (Solver::new(&[], 0.02), goal(&wanted));
        let at = Pose { joints: at.joints.map(|angle| 0.9 * angle), ..at };
        let step: [f64; UNKNOWNS] = std::array::from_fn(|unknown| (seed as f64 + 1.7 * unknown as f64).sin());
        let residuals = |by: f64| {
            let moved = Pose {
                position: std::array::from_fn(|part| at.position[part] + by * step[part]),
                quaternion: normalize(multiply(
                    about_vector(scale(1.0 / norm(&[step[3], step[4], step[5]]), [step[3], step[4], step[5]]),
                        by * norm(&[step[3], step[4], step[5]])), at.quaternion)),
                joints: std::array::from_fn(|joint| at.joints[joint] + by * step[FIRST + joint]),
            };
            let frames = moved.frames();
            let mut all: Vec<f64> = Vec::new();
            for turn in &goal.turns {
                for (index, weight) in turn.weights.iter().enumerate() {
                    all.extend(scale(weight.sqrt(), column(&frames.rotation[turn.body], index)));
                }
            }
            for reach in &goal.reaches {
                all.extend(scale(reach.weight.sqrt(), reach.away(&frames)));
            }
            all.extend(moved.joints.map(|angle| (0.02f64 + 0.01).sqrt() * angle));
            all
        };
        let squares: f64 = residuals(1e-5).iter().zip(residuals(-1e-5)).map(|(a, b)| ((a - b) / 2e-5).powi(2)).sum();
        let matrix = solver.local(&at, &goal).matrix;
        let form: f64 = (0..UNKNOWNS).map(|row| step[row] * dot(&matrix[row], &step)).sum();
        prop_assert!((form - squares).abs() < 1e-5 * form, "{form}, {squares}");
    }

    #[test]
    fn solutions_are_within_the_ranges_and_no_worse_than_the_start(start in pose(), wanted in pose(), away in turn()) {
        let solver = Solver::new(&[(3, 0.5)], 1e-3);
        let mut goal = goal(&wanted);
        // Some targets that no pose has.
        goal.turns.iter_mut().step_by(3).for_each(|turn| turn.rotation = matrix(away));
        let (solved, value) = solver.solve(&start, &goal);
        let begin = solver.moved(&start, &[0.0; UNKNOWNS]);
        prop_assert!(value <= solver.value(&begin.frames(), &begin, &goal));
        prop_assert_eq!(solved.joints[3], 0.5);
        for (angle, [low, high]) in solved.joints.iter().zip(JOINT_RANGES) {
            prop_assert!((low..=high).contains(angle));
        }
    }

    #[test]
    fn a_pose_is_found_again_from_a_pose_nearby(mut wanted in pose(), by in prop::collection::vec(-0.2..0.2f64, 56)) {
        // Near 90° of an upper arm's second hinge the first and the third turn it about one axis. A pose nearby may then be
        // nearer to another solution, at the end of a range: from 77° on.
        for joint in ["lhumerusry", "rhumerusry"].map(crate::body::joint) {
            wanted.joints[joint] = wanted.joints[joint].clamp(-1.0, 1.0);
        }
        let solver = Solver::new(&[], 0.0);
        let goal = Goal { near: ([0.0; 56], 0.0), ..goal(&wanted) };
        let start = Pose { joints: std::array::from_fn(|joint| wanted.joints[joint] + by[joint]), ..wanted.clone() };
        let (solved, _) = solver.solve(&start, &goal);
        for (angle, wanted) in solved.joints.iter().zip(wanted.joints) {
            prop_assert!((angle - wanted).abs() < 1e-4, "{angle}, {wanted}");
        }
    }
}

#[test]
fn the_neutral_pose_is_within_the_ranges() {
    let pose = Solver::new(&[], 1e-3).neutral([0.0; 3], IDENTITY);
    assert!(pose.joints.iter().zip(JOINT_RANGES).all(|(angle, [low, high])| (low..=high).contains(angle)));
}
