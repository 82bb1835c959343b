"""Float64 oracles of SMGDiff: the ball's features, its contacts and guidance, in loops.

Written from the paper (eq. 1-2, 10-15). One clip or one sample at a time, meters, y up
(the paper's z), frames first. What the paper leaves open is said where it occurs.
"""

import numpy as np

REACH, WEIGHTS, JUMPS = 2.0, (0.1, 0.3), (0.5, 1.0)
ACCELERATION, MAX_DISTANCE, GROUNDED_WEIGHT, RATE = 2.0, 0.1, 2.0, 0.5


# The ball's features.


def length(vector):
    return np.sqrt(np.sum(np.asarray(vector, np.float64) ** 2))


def ball_weight(ball, root, reach=REACH):
    """Eq. 1 for one frame; not below 0, which the paper does not say."""
    x, _, z = np.subtract(ball, root, dtype=np.float64)
    return max(1 - np.hypot(x, z) / reach, 0.0)


def encode_ball(ball, velocity, root, reach=REACH):
    """Eq. 2: weighted place 3, velocity 3, weight 1 of each frame [frames, 3]."""
    rows = []
    for b, v, h in zip(ball, velocity, root, strict=True):
        weight = ball_weight(b, h, reach)
        place = weight * np.subtract(b, h, dtype=np.float64)
        rows.append(np.concatenate([place, v, [weight]]))
    return np.array(rows)


def decode_ball(features, root, start, fps):
    """Eq. 2 inverted; small weights and jumps give way to the velocity (ours)."""
    before, rows = np.asarray(start, np.float64), []
    for row, h in zip(np.asarray(features, np.float64), root, strict=True):
        before = before + row[3:6] / fps
        if row[6] > WEIGHTS[0]:
            gap = row[:3] / min(row[6], 1.0) + h - before
            near = np.interp(np.linalg.norm(gap), JUMPS, (1.0, 0.0))
            before = before + near * np.interp(row[6], WEIGHTS, (0.0, 1.0)) * gap
        rows.append(before)
    return np.array(rows)


# Contacts with the ball.


def accelerations(ball, fps):
    """Second differences; none (zero) at the two ends, which have no neighbor."""
    found = np.zeros(np.shape(ball))
    for i in range(1, len(ball) - 1):
        before, here, after = np.asarray(ball[i - 1 : i + 2], np.float64)
        found[i] = (after - 2 * here + before) * fps**2
    return found


def contact_gate(ball, fps, threshold=ACCELERATION):
    """Eq. 10: in which frames something else than the ground moves the ball."""
    return np.array([length(a) > threshold for a in accelerations(ball, fps)])


def nearest_foot(feet, ball, grounded, weight=GROUNDED_WEIGHT):
    """Eq. 11 for one frame: which foot, and its distance times its penalty.

    The paper prints the least of some vectors; their lengths are meant.
    """
    distances = [
        length(np.subtract(foot, ball, dtype=np.float64)) * (1 + (weight - 1) * stands)
        for foot, stands in zip(feet, grounded, strict=True)
    ]
    j = int(np.argmin(distances))
    return j, distances[j]


def contact_loss(
    feet,
    ball,
    grounded,
    gate,
    max_distance=MAX_DISTANCE,
    weight=GROUNDED_WEIGHT,
    delta=0.0,
):
    """Eq. 12, feet [frames, feet, 3]; the threshold meets the penalized distance.

    An indicator over itself plus delta is the indicator, divided by 1 + delta.
    """
    total = 0.0
    for f, b, stands, touched in zip(feet, ball, grounded, gate, strict=True):
        _, distance = nearest_foot(f, b, stands, weight)
        if distance > max_distance and touched:
            total += distance / (1 + delta)
    return total


def contact_loss_gradient(
    feet, ball, grounded, gate, max_distance=MAX_DISTANCE, weight=GROUNDED_WEIGHT
):
    """Derivatives by feet and by ball, all indicators held: of distances alone."""
    by_feet, by_ball = np.zeros(np.shape(feet)), np.zeros(np.shape(ball))
    for i in range(len(ball)):
        j, distance = nearest_foot(feet[i], ball[i], grounded[i], weight)
        if distance > max_distance and gate[i]:
            gap = np.subtract(feet[i][j], ball[i], dtype=np.float64)
            slope = gap / length(gap) * (1 + (weight - 1) * grounded[i][j])
            by_feet[i, j] += slope
            by_ball[i] -= slope
    return by_feet, by_ball


# Guidance.


def dsg_deviation(variances, t, last_sigma=None):
    """Standard deviation of the step from t = 1..T, of T posterior variances.

    That of t = 1 is zero; released code of such samplers puts that of t = 2 there.
    """
    variances = np.asarray(variances, np.float64)
    if t == 1 and last_sigma is not None:
        return last_sigma
    return np.sqrt(variances[max(t, 2) - 1])


def dsg_direction(sigma, gradient, noise, rate):
    """Eq. 13-14: from the drawn noise toward the steepest descent."""
    radius = np.sqrt(np.size(noise)) * sigma
    steepest = -radius * np.asarray(gradient, np.float64) / length(gradient)
    drawn = sigma * np.asarray(noise, np.float64)
    return drawn + rate * (steepest - drawn)


def dsg_update(mean, sigma, gradient, noise, rate=RATE):
    """Eq. 13-15: x_{t-1} from the posterior's mean, on the sphere of radius r.

    r = sqrt(n) sigma. Without a gradient it is the plain ancestral step. The last step
    draws nothing: give zeros as noise, and it goes down whatever the rate, unless 0.
    """
    mean = np.asarray(mean, np.float64)
    if length(gradient) == 0:
        return mean + sigma * np.asarray(noise, np.float64)
    direction = dsg_direction(sigma, gradient, noise, rate)
    if length(direction) == 0:
        return mean
    return mean + np.sqrt(mean.size) * sigma * direction / length(direction)
