/* The loops of a controller's step, for matrices so small that BLAS calls are mostly overhead.

   Each function has an equivalent in Python, which tests it (tests/model/test_native.py) and replaces it without a C
   compiler. Matrices are dense and row-major, sizes are numbers of entries, nothing is allocated or kept; the order of
   summation depends on the sizes and the zeros alone.

   Work arrays are padded: their rows are a multiple of LANES long, so that no loop has a remainder. */

#include <math.h>
#include <stddef.h>
#include <string.h>

#define LANES 8
typedef double lanes __attribute__((vector_size(8 * LANES), aligned(8)));
#define VECTOR(pointer) (*(lanes *)(pointer))
#define INLINE static inline __attribute__((always_inline))

ptrdiff_t padded(ptrdiff_t n) { return (n + LANES - 1) / LANES * LANES; }

INLINE lanes splat(double a) { return a - (lanes){0.0}; }

/* One row of a product over `count` vectors of columns: to[] += sum of value[k] * X[index[k] * width, columns].
   `chains` independent sums hide the latency of additions. */
INLINE void combine(int count, int chains, ptrdiff_t terms, const ptrdiff_t *index, const double *value,
                    const double *X, ptrdiff_t width, double *to)
{
    lanes sum[8];
    for (int v = 0; v < count * chains; v++) sum[v] = splat(0.0);
    ptrdiff_t k = 0;
    for (; k + chains <= terms; k += chains)
        for (int c = 0; c < chains; c++) {
            const lanes *row = (const lanes *)(X + index[k + c] * width);
            const lanes a = splat(value[k + c]);
            for (int v = 0; v < count; v++) sum[c * count + v] += a * row[v];
        }
    for (; k < terms; k++) {
        const lanes *row = (const lanes *)(X + index[k] * width);
        const lanes a = splat(value[k]);
        for (int v = 0; v < count; v++) sum[v] += a * row[v];
    }
    for (int c = 1; c < chains; c++)
        for (int v = 0; v < count; v++) sum[v] += sum[c * count + v];
    for (int v = 0; v < count; v++) ((lanes *)to)[v] += sum[v];
}

static void combine_row(ptrdiff_t terms, const ptrdiff_t *index, const double *value, const double *X,
                        ptrdiff_t width, ptrdiff_t columns, double *to)
{
    ptrdiff_t at = 0;
    for (; at + 8 * LANES <= columns; at += 8 * LANES) combine(8, 1, terms, index, value, X + at, width, to + at);
    for (; at + 4 * LANES <= columns; at += 4 * LANES) combine(4, 2, terms, index, value, X + at, width, to + at);
    for (; at + 2 * LANES <= columns; at += 2 * LANES) combine(2, 4, terms, index, value, X + at, width, to + at);
    for (; at < columns; at += LANES) combine(1, 8, terms, index, value, X + at, width, to + at);
}

/* A square matrix as lists of the nonzero entries of each row: a model's Jacobians are mostly zeros. */
typedef struct {
    ptrdiff_t n, *begin, *index; /* row i: begin[i] .. begin[i + 1] */
    double *value;
} sparse;

static sparse compress(ptrdiff_t n, ptrdiff_t width, const double *A, double *work)
{
    /* Room in `work`: n * n values, n * n indices, n + 1 beginnings. */
    sparse S = {n, (ptrdiff_t *)(work + 2 * n * n), (ptrdiff_t *)(work + n * n), work};
    ptrdiff_t at = 0;
    for (ptrdiff_t i = 0; i < n; i++) {
        S.begin[i] = at;
        for (ptrdiff_t j = 0; j < n; j++) {
            double a = A[i * width + j];
            S.index[at] = j;
            S.value[at] = a;
            at += a != 0.0; /* nan counts as nonzero */
        }
    }
    S.begin[n] = at;
    return S;
}

static void multiply(const sparse *S, const double *X, ptrdiff_t width, double *to)
{
    memset(to, 0, (size_t)(S->n * width) * sizeof *to);
    for (ptrdiff_t i = 0; i < S->n; i++) {
        ptrdiff_t from = S->begin[i];
        combine_row(S->begin[i + 1] - from, S->index + from, S->value + from, X, width, width, to + i * width);
    }
}

/* Largest column sum of magnitudes of rows of length `width`, zero beyond n. */
static double norm(ptrdiff_t n, ptrdiff_t width, const double *X, double *sums)
{
    memset(sums, 0, (size_t)width * sizeof *sums);
    for (ptrdiff_t i = 0; i < n; i++)
        for (ptrdiff_t j = 0; j < width; j++) sums[j] += fabs(X[i * width + j]);
    double largest = 0.0;
    for (ptrdiff_t j = 0; j < n; j++)
        if (!(sums[j] <= largest)) largest = sums[j]; /* nan is kept */
    return largest;
}

INLINE double dot(ptrdiff_t n, const double *a, const double *b)
{
    lanes sum = splat(0.0);
    double rest = 0.0;
    ptrdiff_t j = 0;
    for (; j + LANES <= n; j += LANES) sum += VECTOR(a + j) * VECTOR(b + j);
    for (; j < n; j++) rest += a[j] * b[j];
    for (int v = 0; v < LANES; v++) rest += sum[v];
    return rest;
}

/* A := A Pi, with Pi the derivative of the projection of the rods, (15a). A is stored column by column; each rod's
   direction e and rate Omega begin a block of `block` states, the first one behind `payload` states. */
void along_manifold(ptrdiff_t n, ptrdiff_t payload, ptrdiff_t block, const double *x, double *A)
{
    for (ptrdiff_t at = payload; at < n; at += block) {
        const double *e = x + at, *Omega = e + 3;
        double *by_e = A + at * n, *by_Omega = by_e + 3 * n;
        for (ptrdiff_t i = 0; i < n; i++) {
            const double across = by_e[i] * e[0] + by_e[n + i] * e[1] + by_e[2 * n + i] * e[2];
            const double rate = by_Omega[i] * e[0] + by_Omega[n + i] * e[1] + by_Omega[2 * n + i] * e[2];
            for (ptrdiff_t j = 0; j < 3; j++) {
                by_e[j * n + i] -= across * e[j] + rate * Omega[j];
                by_Omega[j * n + i] -= rate * e[j];
            }
        }
    }
}

ptrdiff_t zero_order_hold_work(ptrdiff_t n, ptrdiff_t m)
{
    return 6 * n * padded(n) + 2 * n * padded(m + 1) + 2 * n * n + n + 1 + padded(n);
}
ptrdiff_t responses_work(ptrdiff_t n, ptrdiff_t m) { return 2 * n * padded(m + 1) + 2 * n * n + n + 1; }
ptrdiff_t condense_work(ptrdiff_t steps, ptrdiff_t p, ptrdiff_t m)
{
    ptrdiff_t D = padded(steps * m);
    return 2 * p * D + 2 * m * (D + padded(m)) + D + p + 4 * LANES;
}

/* Exact zero-order hold: A = I + A_c Phi, B = Phi B_c, f_d = Phi f, Phi = integral of exp(A_c s) over the period.

   The algorithm, its bounds and its names are those of model/discretisation.py.

   A_c and B_c are column-major. theta_max, theta_possible, remainder: as there.
   Returns theta; nothing is computed if it is larger than theta_possible or nan. */
double zero_order_hold(ptrdiff_t n, ptrdiff_t m, const double *A_c, const double *B_c, const double *f,
                       double period, double theta_max, double theta_possible, double remainder,
                       double *A, double *B, double *f_d, double *work)
{
    const ptrdiff_t w = padded(n), inputs = padded(m + 1), all = n * w;
    double *X[5], *P = work, *other = P + all, *swap;
    for (int k = 1; k < 5; k++) X[k] = other + k * all;
    double *right = X[4] + all, *product = right + n * inputs, *lists = product + n * inputs;
    double *sums = lists + 2 * n * n + n + 1;

    memset(X[1], 0, (size_t)all * sizeof *P);
    for (ptrdiff_t i = 0; i < n; i++)
        for (ptrdiff_t j = 0; j < n; j++) X[1][i * w + j] = A_c[j * n + i] * period;
    sparse S = compress(n, w, X[1], lists);
    multiply(&S, X[1], w, X[2]);
    multiply(&S, X[2], w, X[3]);
    const double second = sqrt(norm(n, w, X[2], sums)), third = cbrt(norm(n, w, X[3], sums));
    const double theta = second != second || third != third ? NAN : second > third ? second : third;
    if (!(theta <= theta_possible)) return theta;

    int halvings = 0;
    if (theta > 0.0) {
        const double needed = ceil(log2(theta / theta_max));
        halvings = needed > 0.0 ? (int)needed : 0;
    }
    const double T = ldexp(period, -halvings), short_theta = ldexp(theta, -halvings);
    for (int k = 1; k <= 3 && halvings; k++)
        for (ptrdiff_t i = 0; i < all; i++) X[k][i] = ldexp(X[k][i], -k * halvings);

    int terms = 2;
    for (double term = short_theta * short_theta / 6.0;
         term / (1.0 - short_theta / (terms + 2)) > remainder; term *= short_theta / (terms + 1))
        terms++;
    const int blocks = (terms + 3) / 4;
    double coefficient[4 * 64]; /* 1 / (k + 1)!; the first 170 are nonzero */
    coefficient[0] = 1.0;
    for (int k = 1; k < 4 * blocks; k++) coefficient[k] = coefficient[k - 1] / (k + 1);

    /* P = sum of X^k / (k+1)!, four terms at a time; powers of X commute, so X^4 can be the left factor. */
    if (blocks > 1) {
        S = compress(n, w, X[2], lists);
        multiply(&S, X[2], w, X[4]);
        S = compress(n, w, X[4], lists);
    }
    memset(P, 0, (size_t)all * sizeof *P);
    for (int block = blocks - 1; block >= 0; block--) {
        const double *c = coefficient + 4 * block;
        for (ptrdiff_t i = 0; i < all; i++) P[i] += c[1] * X[1][i] + c[2] * X[2][i] + c[3] * X[3][i];
        for (ptrdiff_t i = 0; i < n; i++) P[i * w + i] += c[0];
        if (block > 0) {
            multiply(&S, P, w, other);
            swap = P, P = other, other = swap;
        }
    }
    /* exp(X) = I + X P; Phi = T P. */
    double *power = X[2], *next = X[3];
    S = compress(n, w, X[1], lists);
    multiply(&S, P, w, power);
    for (ptrdiff_t i = 0; i < n; i++) power[i * w + i] += 1.0;
    for (ptrdiff_t i = 0; i < all; i++) P[i] *= T;
    for (int halving = 0; halving < halvings; halving++) {
        /* Phi(2T) = Phi(T) + exp(A T) Phi(T). */
        S = compress(n, w, power, lists);
        multiply(&S, P, w, other);
        for (ptrdiff_t i = 0; i < all; i++) P[i] += other[i];
        multiply(&S, power, w, next);
        swap = power, power = next, next = swap;
    }

    for (ptrdiff_t i = 0; i < n; i++) memcpy(A + i * n, power + i * w, (size_t)n * sizeof *A);
    memset(right, 0, (size_t)(n * inputs) * sizeof *right);
    for (ptrdiff_t i = 0; i < n; i++) {
        for (ptrdiff_t j = 0; j < m; j++) right[i * inputs + j] = B_c[j * n + i];
        right[i * inputs + m] = f[i];
    }
    S = compress(n, w, P, lists);
    multiply(&S, right, inputs, product);
    for (ptrdiff_t i = 0; i < n; i++) {
        memcpy(B + i * m, product + i * inputs, (size_t)m * sizeof *B);
        f_d[i] = product[i * inputs + m];
    }
    return theta;
}

/* Impulse response A^j B, (steps, n, m), and free response dx(k+1) = A dx(k) + W(k) from zero, (steps + 1, n). */
void responses(ptrdiff_t steps, ptrdiff_t n, ptrdiff_t m, const double *A, const double *B, const double *W,
               double *impulse, double *dX, double *work)
{
    const ptrdiff_t w = padded(m + 1);
    double *now = work, *next = now + n * w;
    sparse S = compress(n, n, A, next + n * w);
    memset(now, 0, (size_t)(n * w) * sizeof *now);
    for (ptrdiff_t i = 0; i < n; i++) memcpy(now + i * w, B + i * m, (size_t)m * sizeof *B);
    for (ptrdiff_t k = 0;; k++) {
        for (ptrdiff_t i = 0; i < n; i++) dX[k * n + i] = now[i * w + m];
        if (k == steps) return;
        for (ptrdiff_t i = 0; i < n; i++)
            memcpy(impulse + (k * n + i) * m, now + i * w, (size_t)m * sizeof *impulse);
        multiply(&S, now, w, next);
        for (ptrdiff_t i = 0; i < n; i++) next[i * w + m] += W[k * n + i];
        double *swap = now;
        now = next, next = swap;
    }
}

/* Condensed Hessian and gradient; see mpc/condensing.py.

   S: effect of the decision on the outputs, (steps, p, m). Q: (p,). weighted: (steps, p).
   H: upper left corner of a matrix with rows of length `stride`; both triangles are written, equal to the bit.
   g: (steps m,). */
void condense(ptrdiff_t steps, ptrdiff_t p, ptrdiff_t m, const double *S, const double *Q, double terminal,
              const double *weighted, double *H, ptrdiff_t stride, double *g, double *work)
{
    const ptrdiff_t D = steps * m, w = padded(D), margin = padded(m);
    double *flat = work, *row = flat + p * w, *now = row + w + margin, *sums = now;
    ptrdiff_t index[p];
    double value[p];
    for (ptrdiff_t o = 0; o < p; o++) {
        index[o] = o;
        for (ptrdiff_t a = 0; a < steps; a++)
            memcpy(flat + o * w + a * m, S + (a * p + o) * m, (size_t)m * sizeof *S);
        memset(flat + o * w + D, 0, (size_t)(w - D) * sizeof *flat);
    }
    /* Running sums down the block diagonals, m rows of them at a time, moved to the right by one block each. */
    memset(sums, 0, (size_t)(m * (w + margin)) * sizeof *sums);
    for (ptrdiff_t a = 0; a < steps; a++) {
        const ptrdiff_t i = steps - 1 - a, columns = padded((a + 1) * m);
        for (ptrdiff_t r = 0; r < m; r++) {
            double *sum = sums + r * (w + margin);
            memset(row, 0, (size_t)columns * sizeof *row);
            for (ptrdiff_t o = 0; o < p; o++) value[o] = Q[o] * flat[o * w + a * m + r];
            combine_row(p, index, value, flat, w, columns, row);
            /* Step N_p has the weight Q_f alone, so the sums with Q end one step earlier, without this product. */
            memmove(sum + m, sum, (size_t)(a * m) * sizeof *sum);
            memset(sum, 0, (size_t)m * sizeof *sum);
            double *to = H + (i * m + r) * stride;
            for (ptrdiff_t b = 0; b <= a; b++) {
                const ptrdiff_t j = steps - 1 - b;
                for (ptrdiff_t c = 0; c < m; c++)
                    to[j * m + c] = terminal * row[b * m + c] + sum[b * m + c];
            }
            for (ptrdiff_t c = 0; c < (a + 1) * m; c++) sum[c] += row[c];
        }
        for (ptrdiff_t r = 0; r < m; r++) {
            /* The lower triangle, from the upper one. */
            const ptrdiff_t x = i * m + r;
            for (ptrdiff_t y = x + 1; y < D; y++) H[y * stride + x] = H[x * stride + y];
        }
    }
    for (ptrdiff_t j = 0; j < steps; j++)
        for (ptrdiff_t c = 0; c < m; c++) g[j * m + c] = 0.0;
    for (ptrdiff_t a = 0; a < steps; a++)
        for (ptrdiff_t o = 0; o < p; o++) {
            const double *effect = S + (a * p + o) * m;
            for (ptrdiff_t j = 0; j + a < steps; j++) {
                const double by = weighted[(j + a) * p + o];
                for (ptrdiff_t c = 0; c < m; c++) g[j * m + c] += effect[c] * by;
            }
        }
}

/* Lower block-Toeplitz matrix of an impulse response, (steps s, steps m), into rows of length `stride`; entries above
   the diagonal stay as they are. */
void toeplitz(ptrdiff_t steps, ptrdiff_t s, ptrdiff_t m, const double *impulse, double *to, ptrdiff_t stride)
{
    for (ptrdiff_t k = 0; k < steps; k++)
        for (ptrdiff_t o = 0; o < s; o++) {
            double *row = to + (k * s + o) * stride;
            for (ptrdiff_t j = 0; j <= k; j++)
                for (ptrdiff_t c = 0; c < m; c++) row[j * m + c] = impulse[((k - j) * s + o) * m + c];
        }
}

/* Free response alone: dx(k+1) = A dx(k) + W(k) from zero, (steps + 1, n). */
void free_response(ptrdiff_t steps, ptrdiff_t n, const double *A, const double *W, double *dX)
{
    memset(dX, 0, (size_t)n * sizeof *dX);
    for (ptrdiff_t k = 0; k < steps; k++)
        for (ptrdiff_t i = 0; i < n; i++)
            dX[(k + 1) * n + i] = dot(n, A + i * n, dX + k * n) + W[k * n + i];
}

#define PIVOTS 16 /* rows of the factor per update of the remaining matrix */

/* H = U' U in place, rows of length `width` (a multiple of LANES, zero beyond n); undefined below the diagonal.
   Returns 0 when H is not positive definite. */
static int factorise(ptrdiff_t n, ptrdiff_t width, double *H)
{
    ptrdiff_t index[PIVOTS];
    double value[PIVOTS];
    for (ptrdiff_t from = 0; from < n; from += PIVOTS) {
        const ptrdiff_t to = from + PIVOTS < n ? from + PIVOTS : n;
        for (ptrdiff_t i = from; i < n; i++) {
            const ptrdiff_t terms = (i < to ? i : to) - from, first = i / LANES * LANES;
            for (ptrdiff_t k = 0; k < terms; k++) {
                index[k] = from + k;
                value[k] = -H[(from + k) * width + i];
            }
            double *row = H + i * width;
            combine_row(terms, index, value, H + first, width, width - first, row + first);
            if (i >= to) continue;
            if (!(row[i] > 0.0)) return 0;
            const double root = 1.0 / sqrt(row[i]);
            for (ptrdiff_t at = first; at < width; at += LANES) VECTOR(row + at) *= splat(root);
        }
    }
    return 1;
}

/* U' U x = b in place, x of length `width`. */
static void substitute(ptrdiff_t n, ptrdiff_t width, const double *U, double *x)
{
    for (ptrdiff_t k = 0; k < n; k++) {
        const double *row = U + k * width;
        x[k] /= row[k];
        for (ptrdiff_t j = k + 1; j < n; j++) x[j] -= row[j] * x[k];
    }
    for (ptrdiff_t k = n - 1; k >= 0; k--) {
        const double *row = U + k * width;
        lanes sum = splat(0.0);
        double rest = 0.0;
        ptrdiff_t j = k + 1;
        for (; j < n && j % LANES; j++) rest += row[j] * x[j];
        for (; j + LANES <= n; j += LANES) sum += VECTOR(row + j) * VECTOR(x + j);
        for (; j < n; j++) rest += row[j] * x[j];
        for (int v = 0; v < LANES; v++) rest += sum[v];
        x[k] = (x[k] - rest) / row[k];
    }
}

ptrdiff_t within_bounds_work(ptrdiff_t n) { return n * padded(n) + 2 * padded(n) + 2 * n; }

/* minimise 1/2 z' H z + g' z within bounds by a primal-dual active-set method; see mpc/bounded.py.

   Returns the number of guesses, or 0 if there were too many or H is not positive definite. */
int within_bounds(ptrdiff_t n, const double *H, const double *g, const double *lower, const double *upper,
                  int most, double *z, double *multipliers, double *work)
{
    double *U = work, *x = U + n * padded(n);
    ptrdiff_t *free_ = (ptrdiff_t *)(x + 2 * padded(n)), *held = free_ + n; /* held: -1 at the lower bound, 1, or 0 */
    for (ptrdiff_t i = 0; i < n; i++) held[i] = lower[i] >= 0.0 && g[i] > 0.0 ? -1 : upper[i] <= 0.0 && g[i] < 0.0;
    for (int guess = 1; guess <= most; guess++) {
        ptrdiff_t free_count = 0;
        for (ptrdiff_t i = 0; i < n; i++) {
            if (held[i]) z[i] = held[i] < 0 ? lower[i] : upper[i];
            else free_[free_count++] = i;
        }
        const ptrdiff_t width = padded(free_count);
        memset(x, 0, (size_t)width * sizeof *x);
        for (ptrdiff_t a = 0; a < free_count; a++) {
            const double *row = H + free_[a] * n;
            double *to = U + a * width, pull = -g[free_[a]];
            for (ptrdiff_t b = 0; b < free_count; b++) to[b] = row[free_[b]];
            for (ptrdiff_t b = free_count; b < width; b++) to[b] = 0.0;
            if (free_count < n)
                for (ptrdiff_t j = 0; j < n; j++)
                    if (held[j]) pull -= row[j] * z[j];
            x[a] = pull;
        }
        if (!factorise(free_count, width, U)) return 0;
        substitute(free_count, width, U, x);
        for (ptrdiff_t a = 0; a < free_count; a++) z[free_[a]] = x[a];
        int changed = 0;
        for (ptrdiff_t i = 0; i < n; i++) {
            ptrdiff_t next = 0;
            multipliers[i] = 0.0;
            if (held[i]) {
                double slope = g[i];
                for (ptrdiff_t j = 0; j < n; j++) slope += H[i * n + j] * z[j];
                multipliers[i] = -slope;
                if (lower[i] == upper[i] || (held[i] < 0 ? slope >= 0.0 : slope <= 0.0)) next = held[i];
            } else if (z[i] < lower[i]) next = -1;
            else if (z[i] > upper[i]) next = 1;
            changed |= next != held[i];
            held[i] = next;
        }
        if (!changed) return guess;
    }
    return 0;
}

static double larger(double a, double b) { return b <= a || a != a ? a : b; } /* nan is kept */

/* Violations of bounds and of complementarity by one value; see mpc/qp.py. */
static void judge(double value, double multiplier, double low, double high, double *outside, double *slackness)
{
    *outside = larger(*outside, larger(low - value, value - high));
    if (multiplier > 0.0) *slackness = larger(*slackness, fabs(multiplier * (isinf(high) ? 1.0 : high - value)));
    else if (multiplier != 0.0) *slackness = larger(*slackness, fabs(multiplier * (isinf(low) ? 1.0 : value - low)));
}

/* Karush-Kuhn-Tucker residuals; see mpc/qp.py. found: stationarity, primal, complementarity. */
void residuals(ptrdiff_t n, ptrdiff_t rows, const double *H, const double *g, const double *lower, const double *upper,
               const double *A, const double *row_lower, const double *row_upper, const double *z,
               const double *bound_multipliers, const double *row_multipliers, double *found, double *work)
{
    double outside = 0.0, slackness = 0.0, slope = 0.0, of_g = 0.0, of_z = 0.0, objective = 0.0, *push = work;
    memset(push, 0, (size_t)n * sizeof *push);
    for (ptrdiff_t r = 0; r < rows; r++) {
        const double *row = A + r * n;
        judge(dot(n, row, z), row_multipliers[r], row_lower[r], row_upper[r], &outside, &slackness);
        if (row_multipliers[r] != 0.0)
            for (ptrdiff_t j = 0; j < n; j++) push[j] += row_multipliers[r] * row[j];
    }
    for (ptrdiff_t i = 0; i < n; i++) {
        const double curved = dot(n, H + i * n, z);
        judge(z[i], bound_multipliers[i], lower[i], upper[i], &outside, &slackness);
        slope = larger(slope, fabs(curved + g[i] + bound_multipliers[i] + push[i]));
        of_g = larger(of_g, fabs(g[i]));
        of_z = larger(of_z, fabs(z[i]));
        objective += z[i] * (0.5 * curved + g[i]);
    }
    found[0] = slope / (1.0 + of_g);
    found[1] = outside / (1.0 + of_z);
    found[2] = slackness / (1.0 + fabs(objective));
}
