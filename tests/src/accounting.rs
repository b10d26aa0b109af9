//! The accounting's law: produced = trained + dropped by reason + in flight.

use comic_proto::v1::Accounting;
use serde_json::Value;

/// [`balance`] of accounting as metrics and `comic-learner status --json` write them.
pub fn balance_of_json(accounting: &Value) -> bool {
    let of = |value: &Value| value.as_u64();
    let dropped = accounting["dropped"].as_object().map(|reasons| reasons.values().filter_map(of).sum::<u64>());
    let parts = [of(&accounting["trained"]), dropped, of(&accounting["in_flight"])];
    of(&accounting["produced"]).is_some_and(|produced| Some(produced) == parts.into_iter().sum::<Option<u64>>())
}

/// produced = trained + dropped by reason + in flight.
pub fn balance(accounting: &Accounting) -> bool {
    let Accounting { produced, trained, in_flight, .. } = *accounting;
    let dropped = accounting.dropped_stale
        + accounting.dropped_invalid
        + accounting.dropped_superseded
        + accounting.dropped_lost_at_restart;
    produced == trained + dropped + in_flight
}
