"""The paper's law: one step longhand, its bound, its lemmas checked in numbers."""

import numpy as np
import pytest
from plants_for_learning import HiddenPlant, optimal_gains

from learning.q_learning.gain_bound import gain_bound
from learning.q_learning.paper_law import LITERAL, REPAIRED, PaperLaw, PaperSettings, Slip
from learning.q_learning.quadratic_cost import QuadraticCost

COST = QuadraticCost(10 * np.eye(2), np.array([[2.0]]), 0.5 * np.eye(2), 10.0)
OSCILLATOR = np.array([[0.0, 1.0], [-0.5, -1.125]]), np.array([[0.0], [0.4]])


def law(slips, period=0.05, cost=COST, seed=0, **changes) -> PaperLaw:
    settings = PaperSettings(sample_period=period, **changes)
    return PaperLaw(cost, settings, np.random.default_rng(seed), slips)


def products(U: np.ndarray, n: int) -> np.ndarray:
    m = len(U) - n
    xx = [U[i] * U[j] for i in range(n) for j in range(i, n)]
    xu = [U[n + k] * U[i] for k in range(m) for i in range(n)]
    uu = [U[n + k] * U[n + j] for k in range(m) for j in range(k, m)]
    return np.array(xx + xu + uu)


def test_the_literal_step_is_the_printed_formula():
    """(19), (22), (23) written out again, with every printed slip."""
    subject = law(LITERAL)
    x0, x1 = np.array([1.0, -0.5]), np.array([0.8, 0.3])
    critic, actor = subject.critic.copy(), subject.actor.copy()
    u0 = subject.control(x0)
    assert np.array_equal(subject.critic, critic)  # one sample makes no difference yet
    nu = subject.time_function
    assert u0 == pytest.approx(nu(0.0) * actor.T @ x0)
    u1 = subject.control(x1)
    assert u1 == pytest.approx(nu(0.05) * actor.T @ x1)
    z0, z1 = products(np.concatenate([x0, u0]), 2), products(np.concatenate([x1, u1]), 2)

    def running(x, u):
        return 0.5 * (x @ COST.M @ x + u @ COST.R @ u)

    sigma, sigma_f = nu(0.05) * (z1 - z0), nu(0.05) * z1
    integral = 0.05 / 2 * (running(x0, u0) + running(x1, u1))
    e_c1 = critic @ (nu(0.05) * z1 - nu(0.05 - 10.0) * z0) + integral
    e_c2 = 0.5 * x1 @ COST.terminal @ x1 - critic @ sigma_f
    step = sigma * e_c1 / (1 + sigma @ sigma) ** 2 + sigma_f * e_c2 / (1 + sigma_f @ sigma_f) ** 2
    assert subject.critic == pytest.approx(critic - 0.05 * 90 * step, rel=1e-12)
    Q = 2 * nu(0.05) * critic  # vech(Q)
    e_a = nu(0.05) * actor.T @ x1 + Q[3:5] @ x1 / Q[5]
    assert subject.actor == pytest.approx(actor - 0.05 * 1.2 * np.outer(x1, e_a), rel=1e-12)


def test_the_repaired_step_is_its_formula():
    subject = law(REPAIRED)
    x0, x1 = np.array([1.0, -0.5]), np.array([0.8, 0.3])
    critic, actor = subject.critic.copy(), subject.actor.copy()
    u0, u1 = subject.control(x0), subject.control(x1)
    nu = subject.time_function
    known = np.array([0, 0, 0, 0, 0, 1.0])

    def s(t, x, u):
        return products(np.concatenate([x, u]), 2) * np.where(known > 0, 1.0, nu(t))

    sigma = s(0.05, x1, u1) - s(0.0, x0, u0)
    running = [0.5 * (x @ COST.M @ x + u @ COST.R @ u) for x, u in ((x0, u0), (x1, u1))]
    e_c1 = critic @ sigma + 0.05 / 2 * sum(running)
    best = -np.linalg.solve(COST.R, [nu(10.0) * critic[3:5] @ x1])
    s_T = s(10.0, x1, best)
    e_c2 = 0.5 * x1 @ COST.terminal @ x1 - critic @ s_T
    step = sigma * e_c1 / (1 + sigma @ sigma) ** 2 - s_T * e_c2 / (1 + s_T @ s_T) ** 2
    expected = critic - 0.05 * 90 * step * (1 - known)
    assert subject.critic == pytest.approx(expected, rel=1e-12)
    mu_x = nu(0.05) * x1
    e_a = actor.T @ mu_x + nu(0.05) * critic[3:5] @ x1 / 2.0
    change = np.outer(mu_x, e_a) / (1 + mu_x @ mu_x)
    assert subject.actor == pytest.approx(actor - 0.05 * 1.2 * change, rel=1e-12)


def test_the_printed_second_term_climbs_and_the_repaired_one_descends():
    """One step with alpha_c small: the terminal error grows, or shrinks (first term silenced)."""
    still = QuadraticCost(np.zeros((2, 2)), COST.R, COST.terminal, COST.horizon)
    x = np.array([1.0, -0.5])
    for slips, sign in ((frozenset({Slip.ASCENT}), 1.0), (REPAIRED, -1.0)):
        subject = law(slips, cost=still, critic_gain=1e-3, initial=0.5)
        subject.actor[:] = 0.0
        subject.control(x)

        def error(weights, of=subject):
            known = np.array([0, 0, 0, 0, 0, 1.0])
            u = -np.array([of.time_function(10.0) * weights[3:5] @ x]) / 2.0
            z = products(np.concatenate([x, u]), 2)
            s = z * np.where(known > 0, 1.0, of.time_function(10.0))
            return abs(0.5 * x @ still.terminal @ x - weights @ s)

        before = error(subject.critic)
        sigma_error = subject.critic[:3].copy()
        subject.control(x)  # the same state: sigma is next to nothing
        assert not np.array_equal(subject.critic[:3], sigma_error)
        assert np.sign(error(subject.critic) - before) == sign


def excited(probing: float) -> PaperLaw:
    subject = law(REPAIRED, period=0.005, probing=probing, critic_gain=1e-9, actor_gain=1e-9)
    plant = HiddenPlant(*OSCILLATOR, [1.0, -0.5], 0.005)
    for _ in range(1500):
        plant.step(subject.control(plant.state))
    return subject


def test_without_probing_the_excitation_is_rank_deficient():
    """Lemma 4.2 needs Delta to be persistently exciting, but U = [I; K] x has only n directions."""
    n, needed = 2, 6
    quiet, probed = excited(0.0), excited(1.0)
    assert quiet.excitation() == 0.0
    # Three products x_i x_j, times two functions of time at most (nu u and nu, u = W nu x).
    assert quiet.excited_rank() < needed
    assert probed.excited_rank() == needed
    assert probed.excitation() > 0.0
    assert n * (n + 1) // 2 <= quiet.excited_rank()


def test_with_probing_the_bellman_error_of_the_exact_q_function_is_not_zero():
    """Q = V + H, and H vanishes at the optimal input alone: (19) is no identity off the optimum.

    On the stationary problem, where one time function suffices, along half a second of motion.
    """
    A, B = OSCILLATOR
    horizon = 40.0
    K = optimal_gains(A, B, COST.M, COST.R, np.zeros((2, 2)), horizon, [0.0])[0]
    from scipy.linalg import solve_continuous_are

    P = solve_continuous_are(A, B, COST.M, COST.R)
    assert pytest.approx(np.linalg.solve(COST.R, B.T @ P), abs=1e-8) == K

    def Q(x, u):
        value = 0.5 * x @ P @ x
        slope = P @ x
        return value + 0.5 * (x @ COST.M @ x + u @ COST.R @ u) + slope @ (A @ x + B @ u)

    def bellman_error(offset: float) -> float:
        """e_c1 at the exact weights under u = -K x + offset, by fine steps."""
        step, x, total = 1e-4, np.array([1.0, -0.5]), 0.0
        plant = HiddenPlant(A - B @ K, B, x, step)
        push = np.array([offset])

        def running(x):
            u = -K @ x + push
            return 0.5 * (x @ COST.M @ x + u @ COST.R @ u)

        first = Q(x, -K @ x + push)
        for _ in range(500):
            before = running(plant.state)
            plant.step(push)
            total += 0.5 * step * (before + running(plant.state))
        return Q(plant.state, -K @ plant.state + push) - first + total

    assert abs(bellman_error(0.0)) < 1e-7
    # H = offset^2 R/2 all along: e_c1 is its integral over 50 ms.
    assert bellman_error(3.0) == pytest.approx(0.05 * 0.5 * 9.0 * 2.0, rel=1e-4)


def test_the_gain_bound_is_the_printed_one():
    Q_xu = np.array([[1.0], [2.0]])
    bound = gain_bound(COST, Q_xu, 0.8, 1.2)
    numerator = 2 * np.linalg.eigvalsh(COST.M + Q_xu @ Q_xu.T / 2)[0]
    numerator -= np.linalg.eigvalsh(Q_xu @ Q_xu.T)[-1]
    assert bound.bound == pytest.approx(numerator / (0.8 * 0.5 / (1 + 0.64) ** 2))
    assert bound.is_admissible
    assert "below the bound" in str(bound)
    assert not gain_bound(COST, Q_xu, 0.8, 1e3).is_admissible


def test_no_gain_is_admissible_on_a_double_integrator():
    """With the exact Q_xu = PB the printed numerator is negative: said, not hidden."""
    A, B = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])
    K = optimal_gains(A, B, COST.M, COST.R, COST.terminal, 10.0, [0.0])[0]
    bound = gain_bound(COST, (COST.R @ K).T, 1.0, 1.2)
    assert bound.bound < 0
    assert not bound.is_admissible
    assert "no alpha_a is admissible" in str(bound)


def test_a_diverged_law_says_so_and_rests():
    A, B = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])
    subject = law(LITERAL)
    plant = HiddenPlant(A, B, [5.0, 0.0], 0.05)
    for _ in range(400):
        if subject.diverged:
            break
        plant.step(subject.control(plant.state))
    assert subject.diverged
    assert not subject.control(np.array([1.0, 0.0])).any()


def test_names_tell_the_slips():
    assert law(LITERAL).name == "paper-literal"
    assert law(REPAIRED).name == "paper-repaired"
    assert law(frozenset({Slip.HALF_VECH})).name == "paper-repaired with HALF_VECH"
    for slip in Slip:
        assert slip.printed
        assert slip.repair


@pytest.mark.parametrize("slip", list(Slip))
def test_every_slip_changes_the_law(slip):
    plain, kept = law(REPAIRED, period=0.005), law(frozenset({slip}), period=0.005)
    motion = np.random.default_rng(0).normal(size=(60, 2))
    for x in motion:
        plain.control(x)
        kept.control(x)
    assert not np.allclose(plain.critic, kept.critic) or not np.allclose(plain.actor, kept.actor)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"resolution": 0.07}, "^resolution: must be a multiple"),
        ({"resolution": 0.0}, "^resolution"),
        ({"critic_gain": -1.0}, "^critic_gain"),
        ({"actor_gain": np.nan}, "^actor_gain"),
        ({"probing": -1.0}, "^probing"),
    ],
)
def test_bad_settings_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        PaperSettings(**change)


def test_bad_states_are_refused():
    with pytest.raises(ValueError, match="state: must be 2 finite"):
        law(REPAIRED).control([np.nan, 0.0])
