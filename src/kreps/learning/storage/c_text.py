"""The text of exported C source: a header, and the code that follows the tables of numbers.

Both are templates.  ``$name`` begins the names of the functions and ``$NAME`` those of the macros.
"""

from __future__ import annotations

from string import Template

HEADER = Template("""\
/* The mean action of a Gaussian process policy on $centres centres, written by kreps $version.
 *
 * C99 without allocation, recursion and state; all sizes are fixed.  Observations and actions are
 * in the units of the task.  Compile without -ffast-math, which removes the tests for NaN:
 *
 *     cc -std=c99 -O2 -c $name.c
 *     cc -std=c99 -O2 -DKREPS_BENCHMARK $name.c -lm   (a program that prints the time of a call)
 */

#ifndef ${NAME}_H
#define ${NAME}_H

#define ${NAME}_OBSERVATIONS $observations
#define ${NAME}_ACTIONS $actions
#define ${NAME}_LAGS $lags /* earlier observations and actions */
#define ${NAME}_ACTION_REPEAT $repeat /* control periods ($period) for which an action is held */

typedef $number ${name}_number;

#ifdef __cplusplus
extern "C" {
#endif
$declarations
#ifdef __cplusplus
}
#endif

#endif
""")

DECLARATIONS = Template("""
/* Sets `action`, within its limits, and returns 0.  If a number of `observation` or of the result
 * is NaN or infinite, returns 1 and leaves `action` as it was. */
int ${name}_act(const ${name}_number observation[${NAME}_OBSERVATIONS],
    ${name}_number action[${NAME}_ACTIONS]);
""")

DECLARATIONS_WITH_LAGS = Template("""
/* Sets `lags` at the start of an episode, from its first observation. */
void ${name}_start(const ${name}_number observation[${NAME}_OBSERVATIONS],
    ${name}_number lags[${NAME}_LAGS]);

/* Sets `action`, within its limits, and `lags` for the next decision, and returns 0.  If a number
 * of `observation`, `lags` or of the result is NaN or infinite, returns 1 and leaves both as they
 * were.  Call it once for each decision, not in each control period. */
int ${name}_act(const ${name}_number observation[${NAME}_OBSERVATIONS],
    ${name}_number lags[${NAME}_LAGS], ${name}_number action[${NAME}_ACTIONS]);
""")

SMOOTH = Template("""
/* Coordinates of a smoothed image, whose pixels are the entries `pixel` of the state. */
static void smooth(const real *state, const int *pixel, real *smoothed)
{
    real rows[DOWN][WIDTH];
    int i, j, k;
    for (i = 0; i < DOWN; i++) {
        for (j = 0; j < WIDTH; j++) {
            rows[i][j] = 0;
            for (k = 0; k < HEIGHT; k++)
                rows[i][j] += down[i][k] * state[pixel[k * WIDTH + j]];
        }
        for (j = 0; j < ACROSS; j++) {
            smoothed[i * ACROSS + j] = 0;
            for (k = 0; k < WIDTH; k++)
                smoothed[i * ACROSS + j] += rows[i][k] * across[j][k];
        }
    }
}
""")

MEAN = Template("""
static void embed(const real *state, real *coordinate)
{
    int i;
$embedding
    for (i = 0; i < COORDINATES; i++)
        coordinate[i] = (coordinate[i] - origin[i]) * per_lengthscale[i];
}

/* Action in the state, within the limits; returns 1 if it is not finite. */
static int mean_action(const real *state, number *action)
{
    real coordinate[COORDINATES], mean[ACTIONS];
    int i, j;
    embed(state, coordinate);
    for (j = 0; j < ACTIONS; j++)
        mean[j] = 0;
    for (i = 0; i < CENTRES; i++) {
        real squares = 0, k;
        for (j = 0; j < COORDINATES; j++) {
            const real difference = coordinate[j] - centre[i][j];
            squares += difference * difference;
        }
        k = exp$f(-squares / 2);
        for (j = 0; j < ACTIONS; j++)
            mean[j] += k * mean_weight[i][j];
    }
    for (j = 0; j < ACTIONS; j++) {
        number commanded;
        mean[j] += action_centre[j];
        commanded = (number)mean[j];
        if (!isfinite(commanded))
            return 1;
        if (commanded < action_low[j])
            commanded = action_low[j];
        if (commanded > action_high[j])
            commanded = action_high[j];
        action[j] = $commanded;
    }
    return 0;
}
""")

ACT = Template("""
int ${name}_act(const number observation[OBSERVATIONS], number action[ACTIONS])
{
    real state[OBSERVATIONS];
    number found[ACTIONS];
    int i;
    for (i = 0; i < OBSERVATIONS; i++) {
        if (!isfinite(observation[i]))
            return 1;
        state[i] = observation[i];
    }
    if (mean_action(state, found))
        return 1;
    for (i = 0; i < ACTIONS; i++)
        action[i] = found[i];
    return 0;
}
""")

ACT_WITH_LAGS = Template("""
/* `lags` has the earlier observations, the newest first, and then the earlier actions, likewise,
 * relative to the centre of their limits in units of half the range. */
void ${name}_start(const number observation[OBSERVATIONS], number lags[LAGS])
{
    int i;
    for (i = 0; i < LAGS; i++)
        lags[i] = i < EARLIER ? observation[i % OBSERVATIONS] : 0;
}

int ${name}_act(const number observation[OBSERVATIONS], number lags[LAGS], number action[ACTIONS])
{
    number known[OBSERVATIONS + LAGS], found[ACTIONS];
    real state[OBSERVATIONS + LAGS];
    int i;
    for (i = 0; i < OBSERVATIONS + LAGS; i++) {
        known[i] = i < OBSERVATIONS ? observation[i] : lags[i - OBSERVATIONS];
        if (!isfinite(known[i]))
            return 1;
        state[i] = known[i];
    }
    for (i = OBSERVATIONS; i < OBSERVATIONS + EARLIER; i++) { /* changes, of angles in [-pi, pi) */
        const real turn = full_turn[i % OBSERVATIONS];
        state[i] = (real)known[i - OBSERVATIONS] - (real)known[i];
        if (turn > 0)
            state[i] -= turn * floor$f(state[i] / turn + (real)0.5);
    }
    if (mean_action(state, found))
        return 1;
    for (i = 0; i < EARLIER; i++)
        lags[i] = known[i];
    for (i = LAGS - 1; i >= EARLIER + ACTIONS; i--)
        lags[i] = lags[i - ACTIONS];
    for (i = 0; i < ACTIONS; i++) {
        action[i] = found[i];
        lags[EARLIER + i] = (found[i] - lag_centre[i]) / lag_scale[i];
    }
    return 0;
}
""")

BENCHMARK = Template("""
#ifdef KREPS_BENCHMARK
/* Prints mean and longest time of 1e5 calls, with observations between -4 and 4. */
int main(void)
{
    enum { CALLS = 100000 };
    number observation[OBSERVATIONS], action[ACTIONS];$lags
    struct timespec begin, end;
    double total = 0, longest = 0;
    unsigned long seed = 1;
    int call, i, failed = 0;
    for (call = 0; call < CALLS; call++) {
        double taken;
        for (i = 0; i < OBSERVATIONS; i++) {
            seed = (1664525UL * seed + 1013904223UL) & 0xffffffffUL;
            observation[i] = (number)((double)seed / 536870912.0 - 4.0);
        }$start
        clock_gettime(CLOCK_MONOTONIC, &begin);
        failed |= ${name}_act(observation, ${argument}action);
        clock_gettime(CLOCK_MONOTONIC, &end);
        taken = (double)(end.tv_sec - begin.tv_sec) + 1e-9 * (double)(end.tv_nsec - begin.tv_nsec);
        total += taken;
        longest = taken > longest ? taken : longest;
    }
    printf("%d calls: mean %.2f us, longest %.2f us\\n", CALLS, 1e6 * total / CALLS, 1e6 * longest);
    return failed;
}
#endif
""")
