"""The compiled algebra of a limited step: bounds on the rates, null-space coordinates, problems for the QP solver."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ssm_decouple.compiled import compiled

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

# What `prepare` returns.
INSIDE = 0  # the plain rates keep all limits
LIMITED = 1  # a vector that keeps them all is known: BRAKE
EXCEEDED = 2  # none along the previous rates keeps rate, position and acceleration limits
NOT_FINITE = 3

# The rows of `columns`: one entry a joint.
LOWER = 0
UPPER = 1
RATE = 2
ACCELERATION = 3  # infinite where it is not limited
COLUMNS_SIZE = 4

# Where the scalars stand in `parameters`.
SAMPLE_TIME = 0
BRAKING = 1
DISTANCE = 2  # that bodies shall keep
NOISE = 3  # a row of J_sub that is shorter constrains nothing
PARAMETERS_SIZE = 4

# The rows of `table`, one entry a joint.
HIGH = 0
LOW = 1
HARD_HIGH = 2  # from position and rate limits alone
HARD_LOW = 3
HIGH_KIND = 4
LOW_KIND = 5
RETURN = 6  # speed that a joint outside its limits shall have; 0 for those inside
CARRIED = 7  # the previous rates, brought to today's J_sub
BRAKE = 8
FIXED = 9  # J_sub^+ wanted
SCRATCH = 10
END = 11
TRIAL = 12
BASIS = 13  # n rows: orthonormal directions of q_dot, then the k + m rows that were factored

# The rows of `sides`, one entry a pair of bodies.
FLOOR = 0  # least rate at which their distance may change
APART = 1  # rate at which those too near shall part; 0 for the others
ROOM = 2  # distance less what shall be kept
SIDES_SIZE = 3

# The rows of `factors`, one entry a factored row.
WEIGHTS = 0
STARTS = 1
DIAGONAL = 2
ORDER = 3
ATTAINED = 4  # what of `wanted` J_sub has the rank for
RESIDUAL = 5  # scratch, one a row of J_sub
FACTORS_SIZE = 6

# Where the results stand in `told`; how many coordinates each level takes follows.
RANK = 0
ASKED = 1  # 1.0 where something is wanted of J_sub
LENGTH = 2  # of FIXED
STOPPABLE = 3  # 1.0 if BRAKE can be scaled down to rest before any limit
RETURNING = 4  # how many joints are outside their limits and how many pairs too near
SCALE = 5  # of the rates
HOLD = 6  # way per speed, s, of braking all together
CAP = 7  # longest braking time, s, at which the turning of null(J_sub) leaves enough acceleration
COUNTS = 8

# Which limit a bound comes from.
NONE = 0
POSITION = 1
RATES = 2
ACCELERATIONS = 3
CURVATURE = 4

EPS = 2.220446049250313e-16
JUST_INSIDE = 1.0 - 8.0 * EPS
# The same for a difference of rates and for a speed from which a joint stops: they round more.
STEP_INSIDE = 1.0 - 1e-12
# Share of the room that a joint takes in one sample at most: below 1, so that it comes to its limit ever slower
# instead of stopping dead, and at 1/2 the rest is 0.1 % after ten samples.
DAMPER = 0.5
SOFTER = 1.5
# Share of the way back that a joint outside its limits takes in one sample.
BACK = 0.1
# A joint this far outside, rad or m, is at its limit: rounding of positions.
AT_LIMIT = 1e-9
# Share of the acceleration kept from braking that the turning of null(J_sub) may take.
CURVATURE_SHARE = 0.5
# Weight of the smallest rates beside a level's task, relative to the square of its rows.
SMALLEST = 1e-8
SOLVABLE = 1e-12  # the same in the coordinates that the task itself decides
# Weight of the change of the rates, in the same units: where limits leave a task hardly any effect, its sign changes
# from sample to sample, and rates would jump from bound to bound. What the task does not decide fades besides.
STEADY = 1e-3
FADE = 0.9
STOPS = 1e-14  # rad or m: rounding of the way to rest
ROUNDING = 1e-12  # of the QP solver's answer, in its units
DEPENDENT = 1e-10  # a bound whose rest beside the others has less than this share of its square depends on them


@compiled
def stretch(braking_time: float, dt: float) -> float:
    """Return the way per speed, s, to rest by equal steps of the speed, one a sample, the first hold at full speed."""
    steps = np.floor(braking_time / dt)
    if steps < 1.0:
        return dt
    return dt * (steps + 1.0) * (1.0 - 0.5 * steps * dt / braking_time)


@compiled
def stopping_speed(room: float, step: float, dt: float) -> float:
    """Return the largest speed from which, held for dt and then less by `step` each sample, `room` is not passed.

    The way is dt (v + (v - step) + (v - 2 step) + ..), piecewise linear in v; m is the number of whole steps in it.
    """
    m = np.floor(0.5 * (np.sqrt(1.0 + 8.0 * room / (dt * step)) - 1.0))
    return (room / dt + 0.5 * step * m * (m + 1.0)) / (m + 1.0)


@compiled
def approach_speed(room: float, hold: float, deceleration: float) -> float:
    """Return the speed at which `room` is approached: room / hold near the limit, with steady deceleration before.

    Near the limit the others may go on as they do: hold is the way per speed that braking all together takes.
    """
    near = deceleration * hold
    if room <= near * hold:
        return room / hold
    return np.sqrt(2.0 * deceleration * room - near * near)


@compiled
def braking_time(rates: Floats, columns: Floats, braking: float) -> float:
    """Return how long, s, scaling the rates (n,) down to rest takes at the share `braking` of all accelerations."""
    longest = 0.0
    for j in range(rates.shape[0]):
        longest = max(longest, abs(rates[j]) / (braking * columns[ACCELERATION, j]))
    return longest


@compiled
def closing_speed(G: Floats, i: int, rates: Floats) -> float:
    """Return the speed at which pair i comes nearer."""
    speed = 0.0
    for j in range(rates.shape[0]):
        speed -= G[i, j] * rates[j]
    return speed


@compiled
def overshoot(rates: Floats, positions: Floats, columns: Floats, parameters: Floats, G: Floats, sides: Floats) -> float:
    """Return how far, rad or m, the rates (n,), held once and then scaled down to rest, pass a limit at most.

    Scaled as a whole they stay in null(J_sub), which braking joint by joint would leave. Below zero where they stop
    before all position limits and clearances.
    """
    hold = stretch(braking_time(rates, columns, parameters[BRAKING]), parameters[SAMPLE_TIME])
    furthest = -np.inf
    for j in range(rates.shape[0]):
        room = columns[UPPER, j] - positions[j] if rates[j] > 0.0 else positions[j] - columns[LOWER, j]
        furthest = max(furthest, abs(rates[j]) * hold - max(room, 0.0))
    for i in range(G.shape[0]):
        furthest = max(furthest, closing_speed(G, i, rates) * hold - max(sides[ROOM, i], 0.0))
    return furthest


@compiled
def stoppable_share(
    start: Floats,
    end: Floats,
    positions: Floats,
    columns: Floats,
    parameters: Floats,
    G: Floats,
    sides: Floats,
    trial: Floats,
) -> float:
    """Return a share in [0, 1] of the way from start (n,) to end that overshoots no limit, by bisection.

    Or not more than start does.
    """
    allowed = max(overshoot(start, positions, columns, parameters, G, sides), STOPS)
    low, high = 0.0, 1.0
    for number in range(40):
        share = 1.0 if number == 0 else 0.5 * (low + high)
        for j in range(start.shape[0]):
            trial[j] = start[j] + share * (end[j] - start[j])
        if overshoot(trial, positions, columns, parameters, G, sides) <= allowed:
            low = share
            if number == 0:
                break
        else:
            high = share
    return low


@compiled
def reflect(rows: Floats, factors: Floats, i: int, start: int) -> float:
    """Make rows[i, start:] a Householder vector that maps that row on its first entry; return the new entry."""
    square = 0.0
    for j in range(start, rows.shape[1]):
        square += rows[i, j] * rows[i, j]
    norm = np.sqrt(square)
    if norm == 0.0:
        factors[WEIGHTS, i] = 0.0
        return 0.0
    head = rows[i, start]
    factors[WEIGHTS, i] = 1.0 / (norm * (norm + abs(head)))
    rows[i, start] = head + norm if head > 0.0 else head - norm
    return -norm if head > 0.0 else norm


@compiled
def apply_reflection(rows: Floats, factors: Floats, i: int, start: int, x: Floats) -> None:
    """Apply the reflection that rows[i, start:] holds to the vector x (n,), in place."""
    product = 0.0
    for j in range(start, x.shape[0]):
        product += rows[i, j] * x[j]
    product *= factors[WEIGHTS, i]
    for j in range(start, x.shape[0]):
        x[j] -= product * rows[i, j]


@compiled
def factor_protected_rows(rows: Floats, factors: Floats, k: int, noise: float) -> int:
    """Make the first k rows lower triangular by reflections, the largest row first; return their rank."""
    n, rank = rows.shape[1], 0
    for i in range(k):
        factors[ORDER, i] = i
    while rank < min(k, n):
        best, largest = rank, -1.0
        for i in range(rank, k):
            square = 0.0
            for j in range(rank, n):
                square += rows[i, j] * rows[i, j]
            if square > largest:
                best, largest = i, square
        if not largest > noise * noise:
            break
        if best != rank:
            factors[ORDER, rank], factors[ORDER, best] = factors[ORDER, best], factors[ORDER, rank]
            for j in range(n):
                rows[rank, j], rows[best, j] = rows[best, j], rows[rank, j]
        factors[DIAGONAL, rank] = reflect(rows, factors, rank, rank)
        for i in range(rank + 1, k):
            apply_reflection(rows, factors, rank, rank, rows[i])
        rank += 1
    return rank


@compiled
def take_out(residual: Floats, table: Floats, factors: Floats, rank: int, x: Floats) -> None:
    """Take J_sub^+ residual off x (n,) in place, with the factors of J_sub and its rank as the step has found it."""
    n, rows, leak = x.shape[0], table[BASIS + x.shape[0] :], table[SCRATCH]
    fill(leak, 0.0)
    for i in range(rank):
        leak[i] = residual[int(factors[ORDER, i])]
        for s in range(i):
            leak[i] -= rows[i, s] * leak[s]
        leak[i] /= factors[DIAGONAL, i]
    for i in range(rank - 1, -1, -1):
        apply_reflection(rows, factors, i, i, leak)
    for j in range(n):
        x[j] -= leak[j]


@compiled
def take_out_leak(J_sub: Floats, table: Floats, factors: Floats, rank: int, share: float, x: Floats) -> None:
    """Bring x (n,) to J_sub x = share ATTAINED in place, by the smallest change, with the factors of J_sub."""
    residual = factors[RESIDUAL]
    for i in range(J_sub.shape[0]):
        residual[i] = -share * factors[ATTAINED, i]
        for j in range(x.shape[0]):
            residual[i] += J_sub[i, j] * x[j]
    take_out(residual, table, factors, rank, x)


@compiled
def dot(a: Floats, b: Floats) -> float:
    """Return the product of two vectors."""
    total = 0.0
    for j in range(a.shape[0]):
        total += a[j] * b[j]
    return total


@compiled
def fill(x: Floats, value: float) -> None:
    """Set all of a vector."""
    for j in range(x.shape[0]):
        x[j] = value


@compiled
def attain(rows: Floats, factors: Floats, wanted: Floats, rank: int) -> None:
    """Fill ATTAINED, the nearest to wanted (k,) in the range of J_sub, by Gram and Schmidt, each direction twice."""
    k = wanted.shape[0]
    attained = factors[ATTAINED]
    for i in range(k):
        attained[i] = wanted[i] if rank == k else 0.0
    if rank == k:
        return
    span = np.zeros((rank, k))
    for s in range(rank):
        own = span[s]
        for i in range(s, k):
            own[int(factors[ORDER, i])] = rows[i, s] if i > s else factors[DIAGONAL, s]
        for _ in range(2):
            for t in range(s):
                product = dot(span[t], own)
                for i in range(k):
                    own[i] -= product * span[t, i]
        product = dot(own, wanted) / dot(own, own)
        length = np.sqrt(dot(own, own))
        for i in range(k):
            attained[i] += product * own[i]
            own[i] /= length


@compiled
def bound_by_limits(
    table: Floats, columns: Floats, parameters: Floats, positions: Floats, previous: Floats, hold: float, cap: float
) -> int:
    """Fill bounds on the rates and which limit each comes from; return how many joints are outside their limits.

    `hold`, s, is the way per speed of braking all together, `cap`, s, the longest braking time.
    """
    n, dt, braking, outside = previous.shape[0], parameters[SAMPLE_TIME], parameters[BRAKING], 0
    for j in range(n):
        a, rate, brake = columns[ACCELERATION, j], JUST_INSIDE * columns[RATE, j], table[BRAKE, j]
        step = STEP_INSIDE * a * dt
        table[RETURN, j] = 0.0
        for side in range(2):
            sign = 1.0 if side == 0 else -1.0
            room = columns[UPPER, j] - positions[j] if side == 0 else positions[j] - columns[LOWER, j]
            if room < -AT_LIMIT:
                outside += 1
                table[RETURN, j] = sign * max(BACK * room / dt, -rate)
            room = max(room, 0.0)
            hard = hard_speed(columns, parameters, positions, j, sign)
            kind = POSITION if hard < rate else RATES
            bound, along = hard, sign * brake
            if room < np.inf:
                near = max(STEP_INSIDE * approach_speed(room, hold, braking * a), along)
                if near < bound:
                    bound, kind = near, POSITION
            slow = max(braking * a * cap, along)
            if slow < bound:
                bound, kind = slow, CURVATURE
            reached = max(sign * previous[j] + step, along)
            if reached < bound:
                bound, kind = reached, ACCELERATIONS
            table[HARD_HIGH + side, j] = sign * hard
            table[HIGH + side, j] = sign * max(bound, along)
            table[HIGH_KIND + side, j] = kind
    return outside


@compiled
def bound_by_clearances(sides: Floats, parameters: Floats, G: Floats, brake: Floats, hold: float) -> int:
    """Fill bounds on the rates at which pairs come nearer; return how many pairs are too near."""
    near, dt = 0, parameters[SAMPLE_TIME]
    for i in range(G.shape[0]):
        room = sides[ROOM, i]
        sides[APART, i] = 0.0
        if room < -AT_LIMIT:
            near += 1
            sides[APART, i] = -BACK * room / dt
        sides[FLOOR, i] = -max(STEP_INSIDE * max(room, 0.0) / hold, closing_speed(G, i, brake))
    return near


@compiled
def hard_speed(columns: Floats, parameters: Floats, positions: Floats, j: int, sign: float) -> float:
    """Return the largest speed of joint j, up for sign 1 and down for -1, that its rate and position limits allow."""
    dt, a, rate = parameters[SAMPLE_TIME], columns[ACCELERATION, j], JUST_INSIDE * columns[RATE, j]
    room = max(columns[UPPER, j] - positions[j] if sign > 0.0 else positions[j] - columns[LOWER, j], 0.0)
    if a == np.inf:
        return min(rate, DAMPER * room / dt)
    return min(rate, STEP_INSIDE * stopping_speed(room, parameters[BRAKING] * a * dt, dt))


@compiled
def push_off(
    direction: Floats,
    amount: float,
    rows: Floats,
    factors: Floats,
    rank: int,
    pushed: Floats,
    count: int,
    rates: Floats,
) -> bool:
    """Change direction . rates by the amount, by the smallest change of rates (n,) that leaves `pushed` ones alone.

    And J_sub, whose factors the first `rank` rows hold. The direction that is left joins the first `count` of the
    orthonormal rows `pushed`. Return False if none is left.
    """
    n = rates.shape[0]
    along, whole = pushed[count], 0.0
    for j in range(n):
        along[j] = direction[j]
        whole += direction[j] ** 2
    for _ in range(2):  # the second time takes out the rounding of the first
        for i in range(rank):
            apply_reflection(rows, factors, i, i, along)
        for j in range(rank):
            along[j] = 0.0
        for i in range(rank - 1, -1, -1):
            apply_reflection(rows, factors, i, i, along)
        for s in range(count):
            product = 0.0
            for j in range(n):
                product += pushed[s, j] * along[j]
            for j in range(n):
                along[j] -= product * pushed[s, j]
    square = 0.0
    for j in range(n):
        square += along[j] ** 2
    if square <= 1e-6 * whole:
        return False
    for j in range(n):
        along[j] /= np.sqrt(square)
        rates[j] += amount / np.sqrt(square) * along[j]
    return True


@compiled
def keep_off(
    rates: Floats,
    positions: Floats,
    columns: Floats,
    parameters: Floats,
    G: Floats,
    sides: Floats,
    rows: Floats,
    factors: Floats,
    rank: int,
) -> None:
    """Push rates (n,) that brake off the limits that they overshoot, the worst first, until none is overshot.

    As null(J_sub) turns from sample to sample, a joint that rests at its limit is given a little speed.
    """
    n = rates.shape[0]
    direction, pushed = np.zeros(n), np.empty((n + 1, n))
    count = 0
    for _ in range(4 * n):
        hold = stretch(braking_time(rates, columns, parameters[BRAKING]), parameters[SAMPLE_TIME])
        worst, most, pair = -1, 0.0, False
        for j in range(n):
            room = columns[UPPER, j] - positions[j] if rates[j] > 0.0 else positions[j] - columns[LOWER, j]
            over = abs(rates[j]) - max(room, 0.0) / hold
            if over > most:
                worst, most = j, over
        for i in range(G.shape[0]):
            over = closing_speed(G, i, rates) - max(sides[ROOM, i], 0.0) / hold
            if over > most:
                worst, most, pair = i, over, True
        if most * hold <= STOPS:
            return
        amount = most
        for j in range(n):
            direction[j] = G[worst, j] if pair else (1.0 if j == worst else 0.0)
        if not pair:
            amount = -amount if rates[worst] > 0.0 else amount
        if push_off(direction, amount, rows, factors, rank, pushed, count, rates):
            count += 1
        elif count == 0:
            return
        else:  # those pushed before are pushed again: the way to rest has changed
            count = 0


@compiled
def keeps_hard_limits(rates: Floats, previous: Floats, positions: Floats, columns: Floats, parameters: Floats) -> bool:
    """Say whether rates (n,) keep acceleration, rate and position limits."""
    for j in range(rates.shape[0]):
        if abs(rates[j] - previous[j]) > columns[ACCELERATION, j] * parameters[SAMPLE_TIME]:
            return False
        sign = 1.0 if rates[j] > 0.0 else -1.0
        if abs(rates[j]) > hard_speed(columns, parameters, positions, j, sign) + STOPS:
            return False
    return True


@compiled
def fill_brake(
    table: Floats,
    columns: Floats,
    parameters: Floats,
    positions: Floats,
    previous: Floats,
    G: Floats,
    sides: Floats,
    factors: Floats,
    rank: int,
    told: Floats,
) -> int:
    """Fill BRAKE, rates that brake and keep the limits, and CAP; return what they keep.

    2 if all and they can be scaled down to rest, 1 if only that fails, 0 if none is found that keep acceleration, rate
    and position limits.
    """
    n, dt, carried, brake = previous.shape[0], parameters[SAMPLE_TIME], table[CARRIED], table[BRAKE]
    braking, time, turned = parameters[BRAKING], braking_time(previous, columns, parameters[BRAKING]), 0.0
    paced = 1.0 - dt / time if time > dt else 0.0
    for j in range(n):
        brake[j] = paced * carried[j]
    if overshoot(brake, positions, columns, parameters, G, sides) > STOPS:
        keep_off(brake, positions, columns, parameters, G, sides, table[BASIS + n :], factors, rank)
    for j in range(n):
        moved = max(abs(carried[j] - previous[j]), abs(brake[j] - paced * previous[j]))
        turned = max(turned, moved / (columns[ACCELERATION, j] * dt))
    # The turning of null(J_sub), and of what joints at their limits leave of it, grows with the square of the rates.
    kept = CURVATURE_SHARE * (1.0 - braking)
    told[CAP] = time * np.sqrt(kept / turned) if turned > 1e-6 * kept else np.inf
    stops = overshoot(brake, positions, columns, parameters, G, sides) <= STOPS
    if stops and keeps_hard_limits(brake, previous, positions, columns, parameters):
        return 2
    # Harder, as far as the acceleration limits go: the same times a factor from `least` to `most`.
    least, most, base = 0.0, 1.0, table[END]
    for j in range(n):
        base[j] = brake[j]
        p, step = abs(base[j]), STEP_INSIDE * columns[ACCELERATION, j] * dt
        along, sign = (previous[j], 1.0) if base[j] > 0.0 else (-previous[j], -1.0)
        if p == 0.0:
            least = 2.0 if abs(along) > step else least
            continue
        least, most = max(least, (along - step) / p), min(most, (along + step) / p)
        most = min(most, (hard_speed(columns, parameters, positions, j, sign) + STOPS) / p)
    if least > most:
        return 0
    for j in range(n):
        brake[j] = most * base[j]
    fill(table[SCRATCH], 0.0)
    factor = most * stoppable_share(table[SCRATCH], brake, positions, columns, parameters, G, sides, table[TRIAL])
    for j in range(n):
        brake[j] = max(factor, least) * base[j]
    return 2 if factor >= least * STEP_INSIDE else 1


@compiled
def fill_bounds(
    columns: Floats,
    parameters: Floats,
    positions: Floats,
    previous: Floats,
    G: Floats,
    table: Floats,
    sides: Floats,
    told: Floats,
) -> None:
    """Fill all bounds, so that BRAKE keeps them, and count in RETURNING what is outside its limits."""
    hold, cap = told[HOLD], told[CAP]
    outside = bound_by_limits(table, columns, parameters, positions, previous, hold, cap)
    told[RETURNING] = outside + bound_by_clearances(sides, parameters, G, table[BRAKE], hold)


@compiled
def inside(table: Floats, sides: Floats, G: Floats, rates: Floats) -> bool:
    """Say whether the rates (n,) keep all bounds."""
    for j in range(rates.shape[0]):
        if not table[LOW, j] <= rates[j] <= table[HIGH, j]:
            return False
    within = True
    for i in range(G.shape[0]):
        within = within and closing_speed(G, i, rates) <= -sides[FLOOR, i]
    return within


@compiled
def fill_basis(table: Floats, factors: Floats, J: Floats, sizes: Floats, k: int, rank: int, told: Floats) -> None:
    """Factor the task rows level by level past J_sub, and fill the orthonormal directions in the order of the levels.

    The rows before a level are lower triangular in the directions before its own, so these move none of them.
    """
    n = J.shape[1]
    rows, at, row = table[BASIS + n :], rank, k
    for level in range(sizes.shape[0]):
        size, square, count = int(sizes[level]), 0.0, 0
        for t in range(row, row + size):
            for j in range(n):
                rows[t, j] = J[t - k, j]
                square += rows[t, j] ** 2
            for i in range(rank):
                apply_reflection(rows, factors, i, i, rows[t])
            for s in range(k, row):
                if factors[STARTS, s] >= 0.0:
                    apply_reflection(rows, factors, s, int(factors[STARTS, s]), rows[t])
        for t in range(row, row + size):
            factors[STARTS, t] = -1.0
            if at + count == n:
                continue
            if abs(reflect(rows, factors, t, at + count)) <= 1e-14 * np.sqrt(square):
                continue
            factors[STARTS, t] = at + count
            for s in range(t + 1, row + size):
                apply_reflection(rows, factors, t, at + count, rows[s])
            count += 1
        told[COUNTS + level] = count
        at += count
        row += size
    for c in range(n):
        x = table[BASIS + c]
        fill(x, 0.0)
        x[c] = 1.0
        for t in range(row - 1, k - 1, -1):
            if factors[STARTS, t] >= 0.0:
                apply_reflection(rows, factors, t, int(factors[STARTS, t]), x)
        for i in range(rank - 1, -1, -1):
            apply_reflection(rows, factors, i, i, x)
    if told[ASKED] > 0.0:  # J_sub^+ wanted takes the place of the last direction that the protection holds
        for j in range(n):
            table[BASIS + rank - 1, j] = table[FIXED, j] / told[LENGTH]


@compiled
def prepare(
    columns: Floats,
    parameters: Floats,
    positions: Floats,
    previous: Floats,
    plain: Floats,
    J_sub: Floats,
    wanted: Floats,
    J: Floats,
    sizes: Floats,
    G: Floats,
    distances: Floats,
    table: Floats,
    sides: Floats,
    factors: Floats,
    told: Floats,
) -> int:
    """Fill what the limited step needs; return INSIDE, LIMITED, EXCEEDED or NOT_FINITE.

    Args:
        columns: (COLUMNS_SIZE, n), for each joint.
        parameters: (PARAMETERS_SIZE,).
        positions: Joint positions (n,), rad or m.
        previous: The rates commanded before (n,).
        plain: The rates that do the tasks without limits (n,).
        J_sub: (k, n).
        wanted: What J_sub q_dot shall be (k,).
        J: The task rows of all levels (m, n).
        sizes: How many rows each level has (levels,).
        G: Rates at which the distances of pairs of bodies change, per joint rate (c, n).
        distances: These distances (c,), m.
        table: (BASIS + n + k + m, n), overwritten.
        sides: (SIDES_SIZE, c), overwritten.
        factors: (FACTORS_SIZE, k + m), overwritten.
        told: (COUNTS + levels,), overwritten.
    """
    n, k, dt, braking = columns.shape[1], J_sub.shape[0], parameters[SAMPLE_TIME], parameters[BRAKING]
    rows, fixed, carried = table[BASIS + n :], table[FIXED], table[CARRIED]
    fill(told, 0.0)
    total, square = 0.0, 0.0
    for i in range(k):
        told[ASKED] = max(told[ASKED], 1.0 if wanted[i] != 0.0 else 0.0)
        total += wanted[i]
        for j in range(n):
            rows[i, j] = J_sub[i, j]
            square += J_sub[i, j] ** 2
    for j in range(n):
        total += positions[j] + previous[j] + plain[j]
    for i in range(distances.shape[0]):
        sides[ROOM, i] = distances[i] - parameters[DISTANCE]
        total += distances[i]
    if not np.isfinite(total + square):
        return NOT_FINITE
    rank = factor_protected_rows(rows, factors, k, max(parameters[NOISE], 16.0 * EPS * np.sqrt(square)))
    told[RANK] = rank
    fill(fixed, 0.0)
    fill(factors[ATTAINED], 0.0)
    if told[ASKED] > 0.0:
        attain(rows, factors, wanted, rank)
        for _ in range(2):  # the second time takes out the rounding of the first
            take_out_leak(J_sub, table, factors, rank, 1.0, fixed)
        told[LENGTH] = np.sqrt(dot(fixed, fixed))
        if told[LENGTH] == 0.0:
            told[ASKED] = 0.0

    # Today's nearest to the previous rates: with a share of `wanted` in [0, 1].
    share = 0.0
    for j in range(n):
        carried[j] = previous[j]
        if told[ASKED] > 0.0:
            share += fixed[j] * previous[j] / told[LENGTH] ** 2
    share = min(max(share, 0.0), 1.0)
    take_out_leak(J_sub, table, factors, rank, share, carried)
    keeps = fill_brake(table, columns, parameters, positions, previous, G, sides, factors, rank, told)
    time, cap = braking_time(previous, columns, braking), told[CAP]
    told[STOPPABLE] = 1.0 if keeps == 2 else 0.0
    longest = 0.0  # braking time that the next rates can have at most
    for j in range(n):
        if columns[ACCELERATION, j] < np.inf:
            longest = max(longest, columns[RATE, j] / (braking * columns[ACCELERATION, j]))
    longest = min(longest, min(time + dt / braking, max(cap, time)))
    hold = max(SOFTER * stretch(longest, dt), dt / DAMPER)
    told[HOLD] = hold
    fill_bounds(columns, parameters, positions, previous, G, table, sides, told)
    free = keeps > 0 and told[RETURNING] == 0.0 and inside(table, sides, G, plain)
    if free and overshoot(plain, positions, columns, parameters, G, sides) <= STOPS:
        return INSIDE
    largest, bounds = 0.0, 0.0
    for j in range(n):
        largest = max(largest, abs(plain[j]))
        for side in range(2):
            if abs(table[HIGH + side, j]) < np.inf:
                bounds = max(bounds, abs(table[HIGH + side, j]))
    told[SCALE] = min(largest, bounds) if min(largest, bounds) > 0.0 else max(max(largest, bounds), 1.0)
    fill_basis(table, factors, J, sizes, k, rank, told)
    return LIMITED if keeps > 0 else EXCEEDED


@compiled
def pose(
    table: Floats,
    sides: Floats,
    G: Floats,
    J: Floats,
    v: Floats,
    first: int,
    decided: int,
    rho: float,
    steady: float,
    scale: float,
    anchor: Floats,
    H: Floats,
    f: Floats,
    A: Floats,
    high: Floats,
    low: Floats,
    length: float,
) -> None:
    """Pose the QP of one level in the directions from `first` on: min |J q_dot - v|^2 + rho |q_dot|^2 in the bounds.

    In the directions before it q_dot is what it is in anchor (n,). The directions from first + decided on do not move
    the level. `steady` is the weight of the change from CARRIED, relative to that of the rows. Rates are in units of
    `scale`. `length` is how long the first direction may be, where it is that of what
    is wanted of J_sub; 0 for no such limit.
    """
    n, size, d, c = J.shape[1], J.shape[0], f.shape[0], G.shape[0]
    before = table[SCRATCH]
    for j in range(n):
        before[j] = anchor[j]
    for a in range(d):
        basis, part = table[BASIS + first + a], 0.0
        for j in range(n):
            part += basis[j] * anchor[j]
            A[j, a] = basis[j]
        for j in range(n):
            before[j] -= part * basis[j]
        for i in range(c):
            A[n + i, a] = 0.0
            for j in range(n):
                A[n + i, a] += G[i, j] * basis[j]
    square = 0.0
    for a in range(d):
        f[a] = 0.0
        for b in range(d):
            H[a, b] = 0.0
    part_of = np.empty(d)
    for r in range(size):
        left = v[r]
        for j in range(n):
            left -= J[r, j] * before[j]
            square += J[r, j] ** 2
        for a in range(decided):
            part_of[a] = 0.0
            for j in range(n):
                part_of[a] += J[r, j] * A[j, a]
        for a in range(decided):
            f[a] -= part_of[a] * left / scale
            for b in range(decided):
                H[a, b] += part_of[a] * part_of[b]
    weight = square if square > 0.0 else 1.0
    for a in range(d):
        fade = 1.0 if a < decided else FADE
        H[a, a] += max(rho, (SOLVABLE if a < decided else SMALLEST) * weight) + steady * weight
        f[a] -= steady * weight * fade * dot(table[BASIS + first + a], table[CARRIED]) / scale
    for j in range(n):  # a little inside, where what is known to be inside leaves room for it
        upper = max(table[HIGH, j] - ROUNDING * scale, min(anchor[j], table[HIGH, j]))
        lower = min(table[LOW, j] + ROUNDING * scale, max(anchor[j], table[LOW, j]))
        high[j] = min(max((upper - before[j]) / scale, -1e30), 1e30)
        low[j] = min(max((lower - before[j]) / scale, -1e30), 1e30)
    for i in range(c):
        moving = 0.0
        for j in range(n):
            moving += G[i, j] * before[j]
        high[n + i] = 1e30
        low[n + i] = (sides[FLOOR, i] - moving) / scale
    if high.shape[0] > n + c:
        for a in range(d):
            A[n + c, a] = 1.0 if a == 0 else 0.0
        high[n + c], low[n + c] = length / scale, 0.0


@compiled
def share_inside(table: Floats, sides: Floats, G: Floats, start: Floats, end: Floats, rounding: float) -> float:
    """Return the largest share in [0, 1] of the way from start (n,), inside all bounds, to end that is inside too."""
    share = 1.0
    for j in range(start.shape[0]):
        way, high, low = end[j] - start[j], table[HIGH, j], table[LOW, j]
        if end[j] > high + rounding:
            share = min(share, (high - start[j]) / way)
        elif end[j] < low - rounding:
            share = min(share, (low - start[j]) / way)
    for i in range(G.shape[0]):
        before, after = closing_speed(G, i, start), closing_speed(G, i, end)
        if after > rounding - sides[FLOOR, i]:
            share = min(share, (-sides[FLOOR, i] - before) / (after - before))
    return max(share, 0.0)


@compiled
def finish(
    columns: Floats,
    parameters: Floats,
    positions: Floats,
    J_sub: Floats,
    G: Floats,
    table: Floats,
    sides: Floats,
    factors: Floats,
    told: Floats,
    first: int,
    y: Floats,
    anchor: Floats,
) -> None:
    """Move anchor (n,), which keeps the limits, towards what y says of the directions from `first` on, as they allow.

    Both are in null(J_sub), or have J_sub q_dot along what is wanted, and so has all the line between them.
    """
    n, end, scale = anchor.shape[0], table[END], told[SCALE]
    for j in range(n):
        end[j] = anchor[j]
    for a in range(y.shape[0]):
        basis, part = table[BASIS + first + a], scale * y[a]
        for j in range(n):
            part -= basis[j] * anchor[j]
        for j in range(n):
            end[j] += part * basis[j]
    share = share_inside(table, sides, G, anchor, end, ROUNDING * scale)
    for j in range(n):
        end[j] = anchor[j] + share * (end[j] - anchor[j])
    share = stoppable_share(anchor, end, positions, columns, parameters, G, sides, table[TRIAL])
    part = 0.0
    for j in range(n):
        anchor[j] += share * (end[j] - anchor[j])
        part += anchor[j] * table[FIXED, j]
    if told[ASKED] > 0.0:
        part = min(max(part / told[LENGTH] ** 2, 0.0), 1.0)
    for _ in range(2):
        take_out_leak(J_sub, table, factors, int(told[RANK]), part, anchor)
    stops = overshoot(anchor, positions, columns, parameters, G, sides) <= 10.0 * STOPS
    told[STOPPABLE] = 1.0 if stops else 0.0


@compiled
def settle(J_sub: Floats, table: Floats, factors: Floats, told: Floats, first: int, y: Floats, rates: Floats) -> None:
    """Fill the rates (n,) that y says, scaled back into rate and position limits."""
    n, factor = rates.shape[0], 1.0
    fill(rates, 0.0)
    for a in range(y.shape[0]):
        for j in range(n):
            rates[j] += y[a] * table[BASIS + first + a, j]
    for j in range(n):
        bound = table[HARD_HIGH, j] if rates[j] > 0.0 else table[HARD_LOW, j]
        if abs(rates[j]) > abs(bound) + STOPS:
            factor = min(factor, abs(bound) / abs(rates[j]))
    part = 0.0
    for j in range(n):
        rates[j] *= factor
        part += rates[j] * table[FIXED, j]
    if told[ASKED] > 0.0:
        part = min(max(part / told[LENGTH] ** 2, 0.0), 1.0)
    take_out_leak(J_sub, table, factors, int(told[RANK]), part, rates)


@compiled
def hold_return(table: Floats, sides: Floats, G: Floats, anchor: Floats) -> None:
    """Let what comes after take nothing from the speed at which joints and pairs return inside their limits."""
    for j in range(anchor.shape[0]):
        if table[RETURN, j] < 0.0:
            table[HIGH, j] = min(table[HIGH, j], anchor[j])
        elif table[RETURN, j] > 0.0:
            table[LOW, j] = max(table[LOW, j], anchor[j])
    for i in range(G.shape[0]):
        if sides[APART, i] > 0.0:
            sides[FLOOR, i] = max(sides[FLOOR, i], -closing_speed(G, i, anchor))


@compiled
def count_at_bounds(bounds: Floats, rates: Floats) -> int:
    """Return how many joints stand at a bound, HIGH or LOW of `bounds`."""
    largest, count = 0.0, 0
    for j in range(rates.shape[0]):
        largest = max(largest, abs(rates[j]))
    near = 1e-7 * (largest + 1e-12)
    for j in range(rates.shape[0]):
        count += rates[j] >= bounds[HIGH, j] - near or rates[j] <= bounds[LOW, j] + near
    return count


@compiled
def lower_factor(M: Floats, size: int, smallest: float, L: Floats) -> bool:
    """Fill the Cholesky factor L of M (size, size); False where a pivot is not above a share of what stood there."""
    for i in range(size):
        for j in range(i + 1):
            left = M[i, j]
            for s in range(j):
                left -= L[i, s] * L[j, s]
            if i > j:
                L[i, j] = left / L[j, j]
            elif left > smallest * M[i, i]:
                L[i, i] = np.sqrt(left)
            else:
                return False
    return True


@compiled
def solve_lower(L: Floats, size: int, x: Floats) -> None:
    """Replace x by L^-1 x."""
    for i in range(size):
        for s in range(i):
            x[i] -= L[i, s] * x[s]
        x[i] /= L[i, i]


@compiled
def solve_upper(L: Floats, size: int, x: Floats) -> None:
    """Replace x by L^-T x."""
    for i in range(size - 1, -1, -1):
        for s in range(i + 1, size):
            x[i] -= L[s, i] * x[s]
        x[i] /= L[i, i]


@compiled
def solve_at(
    H: Floats, f: Floats, A: Floats, high: Floats, low: Floats, active: Floats, work: Floats, y: Floats
) -> bool:
    """Fill the minimiser y (d,) of y^T H y / 2 + f^T y with low <= A y <= high, if it stands at the bounds `active`.

    These (c,) are 1.0 for an upper bound, -1.0 for a lower one and 0.0 for neither. The problem is convex, so that what
    meets the bounds and has multipliers of the right signs is the minimiser, by whatever way it was found; False
    where these bounds are not the ones. `work` (3 d + 2, d) is overwritten.
    """
    d, count = f.shape[0], 0
    L, B, G, w, pushes = work[:d], work[d : 2 * d], work[2 * d : 3 * d], work[3 * d], work[3 * d + 1]
    if not lower_factor(H, d, EPS, L):
        return False
    for i in range(d):
        w[i] = f[i]
    solve_lower(L, d, w)
    for i in range(A.shape[0]):  # in z = L^T y the objective is |z + w|^2 / 2
        if active[i] != 0.0:
            if count == d:
                return False
            for s in range(d):
                B[count, s] = A[i, s]
            solve_lower(L, d, B[count])
            pushes[count] = -(high[i] if active[i] > 0.0 else low[i]) - dot(B[count], w)
            count += 1
    for i in range(count):
        for j in range(i + 1):
            G[i, j] = dot(B[i], B[j])
    if not lower_factor(G, count, DEPENDENT, G):
        return False
    solve_lower(G, count, pushes)
    solve_upper(G, count, pushes)
    at = 0
    for i in range(A.shape[0]):
        if active[i] != 0.0:
            if pushes[at] * active[i] < 0.0:
                return False
            at += 1
    for s in range(d):
        y[s] = -w[s]
        for i in range(count):
            y[s] -= pushes[i] * B[i, s]
    solve_upper(L, d, y)
    for i in range(A.shape[0]):
        value = dot(A[i], y)
        if not low[i] - ROUNDING <= value <= high[i] + ROUNDING:
            return False
    return True
