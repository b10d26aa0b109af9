//! Targets of the value function.

use tch::Tensor;

/// One target for each step and reward term, without gradient: `[B, T, R]`.
///
/// G_t = r_t + γ d_t [(1 − λ) V(s_{t+1}) + λ G_{t+1}] where row t is a transition, G_t = V(s_t) where it is not, and
/// G_T = V(s_T). With λ = 1 this is the paper's n-step return to the unroll's end. A row without a transition holds an
/// episode's last observation. A truncated episode is bootstrapped there; a terminated one has d = 0 before it. So no
/// reward of one episode enters the target of another.
///
/// Every row is G_t = a_t + b_t G_{t+1}, and two such rows in succession are again one, over two steps: after ⌈log₂(T + 1)⌉
/// doublings each row reaches row T. For 32 rows that is a fifth of the operations of a loop over them.
///
/// - `reward`: `[B, T, R]`.
/// - `discount`: `[B, T]`, 0 where the episode terminated.
/// - `valid`: `[B, T]`, 1 where the row is a transition.
/// - `values`: V(s), `[B, T+1, R]`.
pub fn returns(reward: &Tensor, discount: &Tensor, valid: &Tensor, values: &Tensor, gamma: f64, lambda: f64) -> Tensor {
    tch::no_grad(|| {
        let steps = reward.size()[1];
        let transition = valid.gt(0.5).unsqueeze(-1);
        let discount = (discount * gamma).unsqueeze(-1);
        let mut base = reward.shallow_clone();
        if lambda < 1.0 {
            base = &discount * values.narrow(1, 1, steps) * (1.0 - lambda) + base;
        }
        // a and b. No row follows row T.
        let base = base.where_self(&transition, &values.narrow(1, 0, steps));
        let mut sum = Tensor::cat(&[base, values.narrow(1, steps, 1)], 1);
        let mut weight = (discount * lambda).where_scalarother(&transition, 0.0).constant_pad_nd([0, 0, 0, 1]);
        let mut span = 1;
        while span <= steps {
            let rows = steps + 1 - span;
            let [(first, rest), (weights, _)] =
                [&sum, &weight].map(|all| (all.narrow(1, 0, rows), all.narrow(1, rows, span)));
            let reached = first.addcmul(&weights, &sum.narrow(1, span, rows));
            let weights = weights * weight.narrow(1, span, rows);
            (sum, weight) = (Tensor::cat(&[reached, rest], 1), weights.constant_pad_nd([0, 0, 0, span]));
            span *= 2;
        }
        sum.narrow(1, 0, steps)
    })
}
