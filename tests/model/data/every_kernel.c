/* Every kernel of model/kernels/kernels.c once, with numbers of a generator; the results, as bytes, to standard output.

   Built for two processors, it shows what differs between them (tests/model/kernels/test_arm.py). */

#include "kernels.c"

#include <stdio.h>
#include <stdlib.h>

/* Numbers of [-size, size), of which a share is zero, by Knuth's MMIX generator. The seed is the count: arguments of a
   call have no order. */
static double *numbers(ptrdiff_t count, double size, double zeros)
{
    uint64_t state = (uint64_t)count;
    double *to = aligned_alloc(64, (size_t)(count / 8 + 1) * 64), drawn[2];
    for (ptrdiff_t i = 0; i < count; i++) {
        for (int k = 0; k < 2; k++) {
            state = state * 6364136223846793005u + 1442695040888963407u;
            drawn[k] = (double)(state >> 11) / (double)(1ull << 53);
        }
        to[i] = drawn[1] < zeros ? 0.0 : size * (2.0 * drawn[0] - 1.0);
    }
    return to;
}

static double *filled(ptrdiff_t count, double value)
{
    double *to = numbers(count, 0.0, 0.0);
    for (ptrdiff_t i = 0; i < count; i++) to[i] = value;
    return to;
}

static ptrdiff_t *counted(ptrdiff_t count, ptrdiff_t step)
{
    ptrdiff_t *to = malloc((size_t)(count + 1) * sizeof *to);
    for (ptrdiff_t i = 0; i <= count; i++) to[i] = i * step;
    return to;
}

static void show(ptrdiff_t count, const double *from) { fwrite(from, sizeof *from, (size_t)count, stdout); }

/* A difference equation by zero-order hold, of X, U, P, V_x and V_u without a zero. */
static void hold(ptrdiff_t n, ptrdiff_t m, ptrdiff_t r, double period)
{
    const ptrdiff_t columns[] = {n, m, r, n, m}, rows[] = {n, n, n, r, r};
    ptrdiff_t *begin = counted(3 * n + 2 * r, 0), *index = counted(3 * n * (n + m + r), 0), at = 0, line = 0;
    for (int part = 0; part < 5; part++)
        for (ptrdiff_t i = 0; i < rows[part]; i++) {
            for (ptrdiff_t j = 0; j < columns[part]; j++) index[at++] = j;
            begin[++line] = at;
        }
    double *A = filled(n * n, 0.0), *B = filled(n * m, 0.0), *f_d = filled(n, 0.0);
    double *work = filled(zero_order_hold_work(n, m, r), 0.0);
    ptrdiff_t length[2];
    const double theta = zero_order_hold(n, m, r, begin, index, numbers(at, 0.5, 0.2), numbers(n, 1.0, 0.0), period,
                                         2.0, 1e3, 1e-17, 0, length, A, B, f_d, work);
    show(1, &theta), show(n * n, A), show(n * m, B), show(n, f_d);
}

/* Prediction, QP with all kinds of rows, and plan of one UAV of four along a control law. */
static void step(void)
{
    enum { steps = 13, n = 60, m = 4, all = 16, outputs = 13, terms = 1, answering = 12, pairs = 3, angles = 2 };
    enum { D = steps * m, slacks = 2, size = D + slacks, rank = 20, weighted = outputs + terms + answering };
    enum { rows = (steps - 1) * m + steps * (pairs + 2 * angles), kinds = 3 * outputs };
    static const ptrdiff_t pair[] = {0, 1, 0, 2, 0, 3}, angle[] = {6, 7}, own[] = {0, 1, 2, 3};
    const ptrdiff_t room = predict_work(n, all, m) + condense_work(steps, n, m, weighted, n);
    ptrdiff_t *others = counted(answering, 1), *index = counted(kinds, 2);
    for (int i = 0; i < answering; i++) others[i] += m;
    problem p = {
        .steps = steps, .n = n, .m = m, .size = size, .outputs = outputs, .terms = terms, .inputs = answering,
        .model_outputs = outputs, .all_inputs = all, .rank = rank, .pairs = pairs, .angles = angles,
        .terminal = 5.0, .separation = 0.4, .tilt = 0.3, .begin = counted(outputs, 3), .index = index,
        .value = numbers(kinds, 1.0, 0.0), .chosen = counted(outputs, 1), .answering = others, .own = own,
        .pair = pair, .angle = angle, .A = numbers(n * n, 0.1, 0.7), .B = numbers(n * all, 1.0, 0.5),
        .f_d = numbers(n, 0.1, 0.0), .K = numbers(all * n, 0.05, 0.3), .x0 = numbers(n, 0.1, 0.0),
        .u0 = numbers(all, 0.1, 0.0), .uncorrected = numbers(steps * all, 0.1, 0.0),
        .announced = numbers(steps * all, 0.1, 0.5), .y = numbers(outputs, 1.0, 0.0),
        .y_ref = numbers((steps + 1) * outputs, 1.0, 0.0), .slope = numbers(terms * n, 1.0, 0.0),
        .at_x0 = numbers(terms, 1.0, 0.0), .u_target = numbers(all, 0.1, 0.0), .Q = filled(weighted, 2.0),
        .scale = filled(m, 0.7), .effort = filled(m, 3.0), .low = filled(m, -0.5), .high = filled(m, 0.5),
        .rate = filled(m, 0.2), .root = numbers(rank * n, 1.0, 0.2), .error = numbers(n, 1.0, 0.0),
        .end_slope = numbers(n, 1.0, 0.0), .penalties = filled(slacks, 1e3), .effect = filled(n * D, 0.0),
        .feedback = filled(all * D, 0.0), .dX = filled((steps + 1) * n, 0.0), .dU = filled(steps * all, 0.0),
        .U = filled(steps * all, 0.0), .U_free = filled(D, 0.0), .H = filled(size * size, 0.0),
        .g = filled(size, 0.0), .lower = filled(size, 0.0), .upper = filled(size, INFINITY),
        .rows = filled(rows * size, 0.0), .row_lower = filled(rows, -INFINITY), .row_upper = filled(rows, INFINITY),
        .S = filled(weighted * D + steps * all, 0.0), .free = filled(steps * outputs, 0.0),
        .signals = filled((pairs + angles) * (D + steps), 0.0), .kept = filled(kept_work(steps, n, m, weighted, n), 0.0),
        .work = filled(room, 0.0)};
    respond(&p);
    fill(&p);
    show((steps + 1) * n, p.dX), show(steps * all, p.U), show(size * size, p.H), show(size, p.g);
    show(size, p.lower), show(size, p.upper), show(rows * size, p.rows);

    double *z = filled(size, 0.0), *multipliers = filled(size, 0.0), kkt[3] = {0.0};
    const double guesses = solve_within_bounds(size, rows, p.H, p.g, p.lower, p.upper, p.rows, p.row_lower,
                                               p.row_upper, 30, z, multipliers, kkt,
                                               filled(within_bounds_work(size, rows), 0.0));
    show(1, &guesses), show(size, z), show(size, multipliers);

    double *U = filled(D, 0.0), *c = filled(D, 0.0);
    conclude(&p, z, 0.5, U, c);
    show(D, U), show(D, c);
}

int main(void)
{
    hold(60, 16, 6, 0.5);
    hold(37, 5, 3, 8.0); /* halved several times */
    step();

    double *response = filled(8 * 37, 0.0);
    free_response(7, 37, numbers(37 * 37, 0.1, 0.0), numbers(7 * 37, 1.0, 0.0), response);
    show(8 * 37, response);
    return 0;
}
