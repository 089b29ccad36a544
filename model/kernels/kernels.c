/* The loops of a controller's step, for matrices so small that BLAS calls are mostly overhead.

   Each function has an equivalent in Python, which tests it (tests/model/kernels/test_native.py, tests/mpc) and replaces it
   without a C compiler. Matrices are dense and row-major, sizes are numbers of entries, nothing is allocated or kept.
   Numbers in brackets are equations of docs/equations.md, in whose letters the comments are.

   Vectors are as wide as the processor's registers (LANES), but the order of summation depends on the sizes and the
   zeros alone: columns are summed in blocks of BLOCK, which are one vector or several. So each width gives the same
   digits, where multiplication and addition are fused (FMA). Work arrays are padded: their rows are a multiple of BLOCK
   long, so that no loop has a remainder. */

#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>
#ifdef __FMA__
#include <immintrin.h>
#endif

#ifndef LANES /* doubles in a vector: as many as in a register, unless the compiler's command says another number */
#if defined __AVX512F__
#define LANES 8
#elif defined __AVX__
#define LANES 4
#else
#define LANES 2
#endif
#endif
#if defined __AVX512F__ || defined __aarch64__
#define SUMS 16 /* sums at a time: half of the registers */
#else
#define SUMS 8
#endif
#define BLOCK 8 /* a multiple of every LANES */

typedef double lanes __attribute__((vector_size(8 * LANES), aligned(8)));
#define VECTOR(pointer) (*(lanes *)(pointer))
#define INLINE static inline __attribute__((always_inline))

int vector_width(void) { return LANES; }

ptrdiff_t padded(ptrdiff_t n) { return (n + BLOCK - 1) / BLOCK * BLOCK; }

INLINE lanes splat(double a) { return a - (lanes){0.0}; }

/* One row of a product over `count` vectors of columns: to[] += sum of value[k] * X[index[k] * width, columns].
   `chains` independent sums hide the latency of additions. */
INLINE void combine(int count, int chains, ptrdiff_t terms, const ptrdiff_t *index, const double *value,
                    const double *X, ptrdiff_t width, double *to)
{
    /* sum_c = sum of a_k X_k over every `chains`-th k, then to += sum_0 + sum_1 + .. */
    lanes sum[SUMS];
    for (int v = 0; v < count * chains; v++) sum[v] = splat(0.0);
    ptrdiff_t k = 0;
    for (; k + chains <= terms; k += chains)
        for (int c = 0; c < chains; c++) {
            const lanes *row = (const lanes *)(X + index[k + c] * width);
            const lanes a = splat(value[k + c]);
            for (int v = 0; v < count; v++) sum[c * count + v] += a * row[v];
        }
    /* Terms that are left: to the first chain. */
    for (; k < terms; k++) {
        const lanes *row = (const lanes *)(X + index[k] * width);
        const lanes a = splat(value[k]);
        for (int v = 0; v < count; v++) sum[v] += a * row[v];
    }
    for (int c = 1; c < chains; c++)
        for (int v = 0; v < count; v++) sum[v] += sum[c * count + v];
    for (int v = 0; v < count; v++) ((lanes *)to)[v] += sum[v];
}

/* Columns of a product's row in a number of chains that their number alone decides, in passes of as many vectors as
   keep the sums in registers. */
INLINE void combine_columns(int columns, int chains, ptrdiff_t terms, const ptrdiff_t *index, const double *value,
                            const double *X, ptrdiff_t width, double *to)
{
    const int vectors = columns / LANES, most = SUMS / chains, count = vectors < most ? vectors : most;
    for (int at = 0; at < columns; at += count * LANES)
        combine(count, chains, terms, index, value, X + at, width, to + at);
}

/* One row of a product over all columns, a multiple of BLOCK, in the widest groups that fit. */
static void combine_row(ptrdiff_t terms, const ptrdiff_t *index, const double *value, const double *X,
                        ptrdiff_t width, ptrdiff_t columns, double *to)
{
    ptrdiff_t at = 0;
    for (; at + 64 <= columns; at += 64) combine_columns(64, 1, terms, index, value, X + at, width, to + at);
    for (; at + 32 <= columns; at += 32) combine_columns(32, 2, terms, index, value, X + at, width, to + at);
    for (; at + 16 <= columns; at += 16) combine_columns(16, 4, terms, index, value, X + at, width, to + at);
    for (; at < columns; at += 8) combine_columns(8, 8, terms, index, value, X + at, width, to + at);
}

/* A matrix as lists of the nonzero entries of each row: a model's derivatives are mostly zeros. */
typedef struct {
    ptrdiff_t rows;
    const ptrdiff_t *begin, *index; /* row i: begin[i] .. begin[i + 1] */
    const double *value;
} sparse;

static ptrdiff_t compress_work(ptrdiff_t rows, ptrdiff_t columns) { return 2 * rows * columns + rows + 1; }

/* A dense matrix, rows of length `width`, as lists. */
static sparse compress(ptrdiff_t rows, ptrdiff_t columns, ptrdiff_t width, const double *A, double *work)
{
    /* In `work`: values, indices, beginnings. */
    double *value = work;
    ptrdiff_t *index = (ptrdiff_t *)(work + rows * columns), *begin = index + rows * columns, at = 0;
    for (ptrdiff_t i = 0; i < rows; i++) {
        begin[i] = at;
        for (ptrdiff_t j = 0; j < columns; j++) {
            const double a = A[i * width + j];
            index[at] = j;
            value[at] = a;
            at += a != 0.0; /* nan counts as nonzero */
        }
    }
    begin[rows] = at;
    return (sparse){rows, begin, index, value};
}

/* Rows of a matrix given as lists, from the `first` on. */
static sparse part(ptrdiff_t first, ptrdiff_t rows, const ptrdiff_t *begin, const ptrdiff_t *index, const double *value)
{
    return (sparse){rows, begin + first, index, value};
}

/* Row i of a product: to[] += S(i, :) X. */
INLINE void multiply_row(const sparse *S, ptrdiff_t i, const double *X, ptrdiff_t width, ptrdiff_t columns, double *to)
{
    const ptrdiff_t from = S->begin[i];
    combine_row(S->begin[i + 1] - from, S->index + from, S->value + from, X, width, columns, to);
}

/* to = S X, rows of length `width`. */
static void multiply(const sparse *S, const double *X, ptrdiff_t width, double *to)
{
    memset(to, 0, (size_t)(S->rows * width) * sizeof *to);
    for (ptrdiff_t i = 0; i < S->rows; i++) multiply_row(S, i, X, width, width, to + i * width);
}

/* to[] += x' |S| */
static void sum_magnitudes(const sparse *S, const double *x, double *to)
{
    for (ptrdiff_t i = 0; i < S->rows; i++)
        for (ptrdiff_t k = S->begin[i]; k < S->begin[i + 1]; k++) to[S->index[k]] += x[i] * fabs(S->value[k]);
}

/* a' b, in BLOCK chains. */
INLINE double dot(ptrdiff_t n, const double *a, const double *b)
{
    lanes sum[BLOCK / LANES];
    for (int v = 0; v < BLOCK / LANES; v++) sum[v] = splat(0.0);
    double rest = 0.0;
    ptrdiff_t j = 0;
    for (; j + BLOCK <= n; j += BLOCK)
        for (int v = 0; v < BLOCK / LANES; v++) sum[v] += VECTOR(a + j + v * LANES) * VECTOR(b + j + v * LANES);
    for (; j < n; j++) rest += a[j] * b[j];
    for (int i = 0; i < BLOCK; i++) rest += sum[i / LANES][i % LANES];
    return rest;
}

#define POWERS 64  /* most terms of a series; theta <= 2 needs 25 */
#define PANEL 32   /* columns of a product at a time, so that they stay in the cache */
#define WIDEST (PANEL / LANES < SUMS ? PANEL / LANES : SUMS) /* vectors of a panel at a time */

/* Term k of the series (17) from the one before, and its sum: next = scale S X, sum += next, for `count` vectors of
   columns. */
INLINE void next_term(int count, const sparse *S, const double *X, ptrdiff_t width, double scale, double *next,
                      double *sum, ptrdiff_t sum_width)
{
    for (ptrdiff_t i = 0; i < S->rows; i++) {
        lanes row[SUMS];
        for (int v = 0; v < count; v++) row[v] = splat(0.0);
        for (ptrdiff_t k = S->begin[i]; k < S->begin[i + 1]; k++) {
            const lanes *from = (const lanes *)(X + S->index[k] * width), a = splat(S->value[k]);
            for (int v = 0; v < count; v++) row[v] += a * from[v];
        }
        for (int v = 0; v < count; v++) {
            row[v] *= splat(scale);
            ((lanes *)(next + i * width))[v] = row[v];
            ((lanes *)(sum + i * sum_width))[v] += row[v];
        }
    }
}

/* The next of the largest column sums of |X|^j, X = A_c T = (X + P V) T, magnitudes entry by entry: they bound those of
   X^j and cost one product with a vector each. sums: 1' |X|^j, updated; work: n + rows of V. */
static double next_power(const sparse *X, const sparse *P, const sparse *V, double period, double *sums, double *work)
{
    const ptrdiff_t n = X->rows;
    double *next = work, *by_acceleration = next + n, largest = 0.0;
    /* 1' |X|^j = 1' |X|^(j - 1) (|X| + |P| |V|) T: (17) with the factors of (15b). */
    memset(work, 0, (size_t)(n + V->rows) * sizeof *work);
    sum_magnitudes(X, sums, next);
    sum_magnitudes(P, sums, by_acceleration);
    sum_magnitudes(V, by_acceleration, next);
    for (ptrdiff_t j = 0; j < n; j++) {
        sums[j] = next[j] * period;
        if (!(sums[j] <= largest)) largest = sums[j]; /* nan is kept */
    }
    return largest;
}

ptrdiff_t zero_order_hold_work(ptrdiff_t n, ptrdiff_t m, ptrdiff_t accelerations)
{
    const ptrdiff_t width = padded(n + m + 1);
    return 2 * n * width + accelerations * width + 2 * (n + accelerations) * PANEL +
           2 * n * (n + accelerations) + n + 1 + compress_work(n, n) + 3 * BLOCK;
}

/* Length of the series (17): theta as result, numbers of halvings and of terms in `length`, which is not written if theta
   is larger than theta_possible or nan. sums: room for 1' |X|^k, next_power's work behind it. */
static double series_length(const sparse *X, const sparse *P, const sparse *V, double period, double theta_max,
                            double theta_possible, double remainder, ptrdiff_t *length, double *sums, double *work)
{
    /* theta = max(b_2^(1/2), b_3^(1/3)), b_k = | |X|^k |_1, and beta >= 0, the smallest with theta / 2^beta <=
       theta_max: (17). */
    double largest[POWERS + 2];
    for (ptrdiff_t j = 0; j < X->rows; j++) sums[j] = 1.0;
    for (int k = 1; k <= 3; k++) largest[k] = next_power(X, P, V, period, sums, work);
    const double second = sqrt(largest[2]), third = cbrt(largest[3]);
    const double theta = second != second || third != third ? NAN : second > third ? second : third;
    if (!(theta <= theta_possible)) return theta;
    int halvings = 0;
    if (theta > 0.0) {
        const double needed = ceil(log2(theta / theta_max));
        halvings = needed > 0.0 ? (int)needed : 0;
    }
    /* The smallest K whose remainder is small: |X^(k + 2i)| <= |X^k| |X^2|^i, so the rest is at most a geometric series
       that begins with the terms K and K + 1, (b_K / (K + 1)! + b_(K + 1) / (K + 2)!) / (1 - b_2 / ((K + 2) (K + 3))):
       (17). With halvings b_k is 2^(-beta k) times that of the whole period. */
    int terms = 1;
    for (double factorial = 2.0; terms < POWERS; factorial *= ++terms + 1) {
        const int k = terms;
        if (k + 1 > 3) largest[k + 1] = next_power(X, P, V, period, sums, work);
        const double term_k = ldexp(largest[k], -k * halvings) / factorial;
        const double term_next = ldexp(largest[k + 1], -(k + 1) * halvings) / (factorial * (k + 2));
        const double ratio = ldexp(largest[2], -2 * halvings) / ((k + 2.0) * (k + 3.0));
        if (ratio < 1.0 && (term_k + term_next) / (1.0 - ratio) <= remainder) break;
    }
    length[0] = halvings, length[1] = terms;
    return theta;
}

/* Exact zero-order hold about an expansion in factors: [A - I, B, f_d] = Phi [A_c, B_c, f], Phi = integral of
   exp(A_c s) over the period = T sum X^k / (k + 1)!, X = A_c T. See model/linear/discretisation.py.

   A_c = X + P V_x, B_c = U + P V_u; begin, index, value: the rows of X, U, P, V_x, V_u, one after the other; P has
   `accelerations` columns. Phi itself is not formed: the series is applied to the columns of [A_c, B_c, f].
   length: halvings and terms of the series, (2,): result. With `known` it and A and B are those of another f and the
   same A_c, B_c; A and B may be null then, and only f_d is computed.
   Returns theta, 0 with `known`; nothing is computed if it is larger than theta_possible or nan. */
double zero_order_hold(ptrdiff_t n, ptrdiff_t m, ptrdiff_t accelerations, const ptrdiff_t *begin,
                       const ptrdiff_t *index, const double *value, const double *f, double period, double theta_max,
                       double theta_possible, double remainder, int known, ptrdiff_t *length, double *A, double *B,
                       double *f_d, double *work)
{
    const ptrdiff_t columns = n + m + 1, width = padded(columns), r = accelerations;
    const sparse X = part(0, n, begin, index, value), U = part(n, n, begin, index, value);
    const sparse P = part(2 * n, n, begin, index, value), V_x = part(3 * n, r, begin, index, value);
    const sparse V_u = part(3 * n + r, r, begin, index, value);
    double *sum = work, *product = sum + n * width, *V = product + n * width, *term = V + r * width;
    double *next = term + (n + r) * PANEL, *merged = next + (n + r) * PANEL;
    double *lists = merged + 2 * n * (n + r) + n + 1;

    double theta = 0.0;
    if (!known) {
        theta = series_length(&X, &P, &V_x, period, theta_max, theta_possible, remainder, length, term, next);
        if (!(theta <= theta_possible)) return theta;
    }
    const ptrdiff_t halvings = length[0], terms = length[1];
    /* T = T_s / 2^beta. */
    const double T = ldexp(period, -(int)halvings);

    /* Columns before this one hold no values: with A and B known the panel of f_d alone is computed. */
    const ptrdiff_t first_column = known && !halvings ? (n + m) / PANEL * PANEL : 0;
    /* V = [V_x, V_u, 0]. */
    memset(V, 0, (size_t)(r * width) * sizeof *V);
    for (ptrdiff_t i = 0; i < r; i++) {
        for (ptrdiff_t k = V_x.begin[i]; k < V_x.begin[i + 1]; k++) V[i * width + index[k]] = value[k];
        for (ptrdiff_t k = V_u.begin[i]; k < V_u.begin[i + 1]; k++) V[i * width + n + index[k]] = value[k];
    }
    /* sum = T [X + P V_x, U + P V_u, f] = T [A_c, B_c, f], the first term of (17): (15b). */
    memset(sum, 0, (size_t)(n * width) * sizeof *sum);
    for (ptrdiff_t i = 0; i < n; i++) {
        double *row = sum + i * width;
        for (ptrdiff_t k = X.begin[i]; k < X.begin[i + 1]; k++) row[index[k]] = value[k];
        for (ptrdiff_t k = U.begin[i]; k < U.begin[i + 1]; k++) row[n + index[k]] = value[k];
        row[n + m] = f[i];
        multiply_row(&P, i, V + first_column, width, width - first_column, row + first_column);
        for (ptrdiff_t j = first_column; j < width; j++) row[j] *= T;
    }
    /* [X P], to be multiplied with a term and, below it, V_x times that term. */
    ptrdiff_t *places = (ptrdiff_t *)(merged + n * (n + r)), *first = places + n * (n + r), entries = 0;
    for (ptrdiff_t i = 0; i < n; i++) {
        first[i] = entries;
        for (ptrdiff_t k = X.begin[i]; k < X.begin[i + 1]; k++)
            if (value[k] != 0.0) merged[entries] = value[k], places[entries++] = index[k];
        for (ptrdiff_t k = P.begin[i]; k < P.begin[i + 1]; k++)
            if (value[k] != 0.0) merged[entries] = value[k], places[entries++] = n + index[k];
    }
    first[n] = entries;
    const sparse XP = {n, first, places, merged};
    /* sum = Phi(T) [A_c, B_c, f] = [A - I, B, f_d], panel by panel; with A and B known only the panel of f_d: (16),
       (17). */
    for (ptrdiff_t at = first_column; at < width; at += PANEL) {
        const ptrdiff_t some = width - at < PANEL ? width - at : PANEL;
        for (ptrdiff_t i = 0; i < n; i++) memcpy(term + i * some, sum + i * width + at, (size_t)some * sizeof *term);
        for (ptrdiff_t k = 1; k < terms; k++) {
            /* Term k = (X + P V_x) T / (k + 1) times term k - 1, with [X P] and, below the term, V_x times it. */
            const double scale = T / (double)(k + 1);
            multiply(&V_x, term, some, term + n * some);
            ptrdiff_t v = 0;
            for (; v + WIDEST * LANES <= some; v += WIDEST * LANES)
                next_term(WIDEST, &XP, term + v, some, scale, next + v, sum + at + v, width);
            for (; v + 2 * BLOCK <= some; v += 2 * BLOCK)
                next_term(2 * BLOCK / LANES, &XP, term + v, some, scale, next + v, sum + at + v, width);
            for (; v < some; v += BLOCK)
                next_term(BLOCK / LANES, &XP, term + v, some, scale, next + v, sum + at + v, width);
            double *swap = term;
            term = next, next = swap;
        }
    }
    for (ptrdiff_t halving = 0; halving < halvings; halving++) {
        /* Phi(2T) = Phi(T) + e^(A_c T) Phi(T), so
           [A - I, B, f_d] <- 2 [A - I, B, f_d] + (A - I) [A - I, B, f_d]: (17). */
        const sparse S = compress(n, n, width, sum, lists);
        multiply(&S, sum, width, product);
        for (ptrdiff_t i = 0; i < n * width; i++) sum[i] = 2.0 * sum[i] + product[i];
    }
    /* A = I + A_c Phi, B = Phi B_c, f_d = Phi f: (16). */
    for (ptrdiff_t i = 0; i < n; i++) {
        const double *row = sum + i * width;
        f_d[i] = row[n + m];
        if (known) continue;
        memcpy(A + i * n, row, (size_t)n * sizeof *A);
        A[i * n + i] += 1.0;
        memcpy(B + i * m, row + n, (size_t)m * sizeof *B);
    }
    return theta;
}

/* Number of columns that `combine_row` sums in one way, around column `at` of `columns`. */
static ptrdiff_t group_of(ptrdiff_t at, ptrdiff_t columns)
{
    ptrdiff_t group = 64;
    for (ptrdiff_t begin = 0;; begin += group) {
        while (begin + group > columns) group /= 2;
        if (at < begin + group) return group;
    }
}

ptrdiff_t predict_work(ptrdiff_t n, ptrdiff_t m, ptrdiff_t own)
{
    const ptrdiff_t w = padded(own + 1);
    return (2 * n + m) * w + (n + m) * group_of(own, w) + compress_work(n, n) + compress_work(n, m) +
           compress_work(m, n) + n * m + 3 * BLOCK;
}

/* Effect of each decision and free response over the horizon, with the others' inputs fed back,

       x(k+1) = A x(k) + f_d + B_own v(k) + B_others (drive(k) + K x(k)),   x(0) = 0;

   (22)-(24), (35); see mpc/program/prediction.py.

   own: (count,). K: (m, n), 0 without feedback. drive: (steps, m). impulse: (n, steps, count), effect on the state one,
   two, .. steps later. dX: (steps + 1, n). feedback = K impulse, (m, steps, count); dU = K dX, (steps, m). */
void predict(ptrdiff_t steps, ptrdiff_t n, ptrdiff_t m, ptrdiff_t count, const ptrdiff_t *own, const double *A,
             const double *B, const double *f_d, const double *K, const double *drive, double *impulse, double *dX,
             double *feedback, double *dU, double *work)
{
    const ptrdiff_t w = padded(count + 1), D = steps * count, some = group_of(count, w);
    double *now = work, *next = now + n * w, *inputs = next + n * w, *driven = inputs + m * w;
    double *drives = driven + n * some, *lists = drives + m * some;
    double *B_others = lists + compress_work(n, n) + compress_work(n, m) + compress_work(m, n);
    const sparse A_ = compress(n, n, n, A, lists);
    /* now = [S(0) = B_own, x^free(0) = 0]; B_others = B without the owned columns. */
    memset(now, 0, (size_t)(n * w) * sizeof *now);
    memcpy(B_others, B, (size_t)(n * m) * sizeof *B);
    for (ptrdiff_t c = 0; c < count; c++)
        for (ptrdiff_t i = 0; i < n; i++) {
            now[i * w + c] = B[i * m + own[c]];
            B_others[i * m + own[c]] = 0.0;
        }
    const sparse B_ = compress(n, m, m, B_others, lists + compress_work(n, n));
    sparse K_;
    if (K) K_ = compress(m, n, n, K, lists + compress_work(n, n) + compress_work(n, m));
    /* [S(k+1), x^free(k+1)] = (A + B_others K) [S(k), x^free(k)] + [0, B_others drive(k) + f_d]. */
    for (ptrdiff_t k = 0;; k++) {
        for (ptrdiff_t i = 0; i < n; i++) dX[k * n + i] = now[i * w + count];
        if (k == steps) return;
        for (ptrdiff_t i = 0; i < n; i++)
            memcpy(impulse + i * D + k * count, now + i * w, (size_t)count * sizeof *impulse);
        multiply(&A_, now, w, next);
        if (K) {
            /* Answers of the law to decision and state, K S(k) and K x^free(k): (35). */
            multiply(&K_, now, w, inputs);
            for (ptrdiff_t i = 0; i < m; i++) {
                memcpy(feedback + i * D + k * count, inputs + i * w, (size_t)count * sizeof *feedback);
                dU[k * m + i] = inputs[i * w + count];
                inputs[i * w + count] += drive[k * m + i];
            }
            for (ptrdiff_t i = 0; i < n; i++) multiply_row(&B_, i, inputs, w, w, next + i * w);
        } else {
            /* B_others drive(k), of as many steps at once as are summed alike. */
            if (k % some == 0) {
                for (ptrdiff_t i = 0; i < m; i++)
                    for (ptrdiff_t j = 0; j < some; j++)
                        drives[i * some + j] = k + j < steps ? drive[(k + j) * m + i] : 0.0;
                multiply(&B_, drives, some, driven);
            }
            for (ptrdiff_t i = 0; i < n; i++) next[i * w + count] += driven[i * some + k % some];
        }
        for (ptrdiff_t i = 0; i < n; i++) next[i * w + count] += f_d[i];
        double *swap = now;
        now = next, next = swap;
    }
}

#define PART (LANES < 4 ? LANES : 4) /* four chains in vectors of at most four */
typedef double chains __attribute__((vector_size(8 * PART), aligned(8)));
#define CHAINS(pointer) (*(const chains *)(pointer))
#if defined __FMA__ && LANES >= 4 /* compilers for some processors would not fuse all of them */
#define ADDED(a, b, sum) _mm256_fmadd_pd(a, b, sum)
#elif defined __FMA__
#define ADDED(a, b, sum) _mm_fmadd_pd(a, b, sum)
#else
#define ADDED(a, b, sum) ((a) * (b) + (sum))
#endif

/* Some rows of a matrix times a vector, each in four chains: the order of BLAS on processors with AVX2, as the results
   were first made so. Several rows hide the latency of additions. */
INLINE void chained_rows(int count, ptrdiff_t n, const double *A, const double *b, double *to)
{
    /* to_r = sum of A_rj b_j over j = 0, 4, .. ; 1, 5, .. ; 2, 6, .. ; 3, 7, .. , and what is left. */
    chains sum[8][4 / PART];
    for (int r = 0; r < count; r++)
        for (int c = 0; c < 4 / PART; c++) sum[r][c] = (chains){0.0};
    ptrdiff_t j = 0;
    for (; j + 4 <= n; j += 4)
        for (int r = 0; r < count; r++)
            for (int c = 0; c < 4 / PART; c++)
                sum[r][c] = ADDED(CHAINS(A + r * n + j + c * PART), CHAINS(b + j + c * PART), sum[r][c]);
    for (int r = 0; r < count; r++) {
        const chains *part = sum[r];
        double total = (part[0][0] + part[2 / PART][2 % PART]) + (part[1 / PART][1 % PART] + part[3 / PART][3 % PART]);
        for (ptrdiff_t i = j; i < n; i++) total += A[r * n + i] * b[i];
        to[r] = total;
    }
}

/* to = A b in the order of `chained_rows`. */
static void chained(ptrdiff_t rows, ptrdiff_t n, const double *A, const double *b, double *to)
{
    ptrdiff_t i = 0;
    const int some = 8 / (4 / PART);
    for (; i + some <= rows; i += some) chained_rows(some, n, A + i * n, b, to + i);
    for (; i < rows; i++) chained_rows(1, n, A + i * n, b, to + i);
}

/* Response from zero to a drive, dX(k + 1) = A dX(k) + W(k), (steps + 1, n): (23). */
void free_response(ptrdiff_t steps, ptrdiff_t n, const double *A, const double *W, double *dX)
{
    memset(dX, 0, (size_t)n * sizeof *dX);
    for (ptrdiff_t k = 0; k < steps; k++) {
        chained(n, n, A, dX + k * n, dX + (k + 1) * n);
        for (ptrdiff_t i = 0; i < n; i++) dX[(k + 1) * n + i] += W[k * n + i];
    }
}

/* States Z, (steps + 1, n), and inputs U, (steps, m), under u = at_x0 + K (x - x0) within bounds: (35a), (73); see
   mpc/program/rollout.py. K: (m, n), or with `varying` of each step, (steps, m, n).

   advance: a CasADi function (x, u, p, F, h) -> x; arg, res, iw, w: room for it, arg[2] to arg[4] are set. */
void rollout(ptrdiff_t steps, ptrdiff_t n, ptrdiff_t m,
             int (*advance)(const double **, double **, long long *, double *, int), const double **arg, double **res,
             long long *iw, double *w, int varying, const double *K, const double *at_x0, const double *lower,
             const double *upper, double *Z, double *U)
{
    for (ptrdiff_t k = 0; k < steps; k++) {
        const double *gain = varying ? K + k * m * n : K;
        double *x = Z + k * n, *ahead = x + n, *u = U + k * m;
        /* u(k) = clip(at_x0(k) + K (x(k) - x0)); `ahead` is room for the difference. */
        for (ptrdiff_t i = 0; i < n; i++) ahead[i] = x[i] - Z[i];
        chained(m, n, gain, ahead, u);
        for (ptrdiff_t i = 0; i < m; i++) {
            const double wanted = at_x0[k * m + i] + u[i];
            u[i] = wanted < lower[i] ? lower[i] : wanted > upper[i] ? upper[i] : wanted;
        }
        /* x(k + 1): one step of (13b). */
        arg[0] = x, arg[1] = u, res[0] = ahead;
        advance(arg, res, iw, w, 0);
    }
}

/* Answer of the owned inputs' feedback i to the decisions before step k: sum_{j < k} feedback(k - 1 - j) v(j). */
INLINE double answer(ptrdiff_t steps, ptrdiff_t m, ptrdiff_t i, ptrdiff_t k, const double *feedback, const double *v)
{
    const double *effect = feedback + i * steps * m;
    double sum = 0.0;
    for (ptrdiff_t j = 0; j < k; j++)
        for (ptrdiff_t c = 0; c < m; c++) sum += effect[(k - 1 - j) * m + c] * v[j * m + c];
    return sum;
}

/* Plan from a solution by mixing corrections c to the shared control law with the previous ones; see mpc/program/relaxation.py.

   own: (m,) of all inputs. z: scaled decision, (steps, m). uncorrected, previous, dU: (steps, all): inputs by the law at
   x0, corrections, K dX. feedback: (all, steps, m). w: of the new corrections, 0 for none.
   U: (steps, m), within bounds and rates (w < 1). c, work: (steps, m). */
static void relax(ptrdiff_t steps, ptrdiff_t m, ptrdiff_t all, const ptrdiff_t *own, const double *z, const double *scale,
                  const double *U_free, const double *uncorrected, const double *previous, const double *dU,
                  const double *feedback, double w, const double *lower, const double *upper, const double *rate,
                  double *U, double *c, double *work)
{
    /* u* = clip(u_0 + Lambda z), v = u* - u_0: (24), (27a), (28a). */
    double *v = work;
    for (ptrdiff_t k = 0; k < steps; k++)
        for (ptrdiff_t i = 0; i < m; i++) {
            const ptrdiff_t at = k * m + i;
            const double best = U_free[at] + z[at] * scale[i];
            U[at] = best < lower[i] ? lower[i] : best > upper[i] ? upper[i] : best;
            v[at] = U[at] - U_free[at];
        }
    /* c = w (u* - u_law - K dx) + (1 - w) c^shift: (36a). */
    for (ptrdiff_t k = 0; k < steps; k++)
        for (ptrdiff_t i = 0; i < m; i++) {
            const ptrdiff_t at = k * m + i, of = k * all + own[i];
            if (w == 0.0) c[at] = previous[of];
            else {
                const double fed_back = dU[of] + answer(steps, m, own[i], k, feedback, v);
                c[at] = w * (U[at] - uncorrected[of] - fed_back);
                if (w < 1.0) c[at] += (1.0 - w) * previous[of];
            }
        }
    /* The plan that these corrections give, u = u_law + c + K dx, within rates, then bounds: (28a), (30a), (36a). */
    if (w == 1.0) return;
    for (ptrdiff_t k = 0; k < steps; k++)
        for (ptrdiff_t i = 0; i < m; i++) {
            const ptrdiff_t at = k * m + i, of = k * all + own[i];
            const double before = k ? U[at - m] : U_free[i], least = before - rate[i], most = before + rate[i];
            double u = uncorrected[of] + c[at] + dU[of] + answer(steps, m, own[i], k, feedback, v);
            u = u < least ? least : u > most ? most : u;
            U[at] = u < lower[i] ? lower[i] : u > upper[i] ? upper[i] : u;
            v[at] = U[at] - U_free[at];
        }
}

/* The problem of one step; see mpc/program/compiled_program.py. Three kinds of outputs: the model's, the user's terms, and the
   inputs of the other agents' UAVs. Sizes of arrays behind their names; D = steps * m. */
typedef struct {
    ptrdiff_t steps, n, m, size;              /* horizon, states, owned inputs, decisions and slacks */
    ptrdiff_t outputs, terms, inputs;         /* outputs of each kind */
    ptrdiff_t model_outputs, all_inputs, rank; /* lengths of y and u, rows of the root */
    ptrdiff_t pairs, angles;                  /* limited distances and angles, the user's rows behind theirs */
    ptrdiff_t known;                          /* whether effects, Hessian and rows of angles are those of the QP before */
    double terminal;                          /* weight of the last step, as a multiple of Q */
    double separation, tilt;                  /* smallest distance, largest angle */
    const ptrdiff_t *begin, *index;           /* rows of C as lists */
    const double *value;
    const ptrdiff_t *chosen, *answering, *own; /* (outputs), (inputs), (m): rows of C, of feedback, of u */
    const ptrdiff_t *pair, *angle;            /* (pairs, 2): UAVs; (angles): states */
    const double *A, *B, *f_d, *K;            /* difference equation and gain: (n, n), (n, all_inputs), (n), (all_inputs, n) */
    const double *x0, *u0;                    /* linearised about: (n), (all_inputs) */
    const double *uncorrected, *announced;    /* (steps, all_inputs): law without corrections; these, or inputs without law */
    const double *y, *y_ref;                  /* (model_outputs), (steps + 1, model_outputs) */
    const double *slope, *at_x0;              /* of the user's terms: (terms, n), (terms) */
    const double *u_target;                   /* (all_inputs) */
    const double *Q, *scale, *effort;         /* (outputs of all kinds), (m), (m): R scale */
    const double *low, *high, *rate;          /* limits of the owned inputs, (m) */
    const double *root, *error, *end_slope;   /* of the cost-to-go: (rank, n), (n), (n) */
    const double *penalties;                  /* (size - D) */
    double *effect, *feedback;                /* (n, D), (all_inputs, D), for decisions in SI units: result */
    double *dX, *dU, *U, *U_free;             /* (steps + 1, n), (steps, all_inputs) twice, (steps, m): result */
    double *H, *g;                            /* (size, size), (size): result */
    double *lower, *upper;                    /* (size): bounds, the slacks' as they are: result */
    double *rows, *row_lower, *row_upper;     /* rows of length `size` and bounds on them: result */
    double *S, *free;                         /* (outputs of all kinds, D), (steps, outputs): result */
    double *signals;                          /* (pairs or angles, D) and (steps, pairs), for the rows */
    double *kept;                             /* effects on states, outputs and root, for the next QP */
    double *work;
} problem;

/* Prediction without decision, and the effect of decisions; see mpc/program/prediction.py. */
void respond(const problem *p)
{
    const ptrdiff_t all = p->all_inputs;
    /* U = u_law(x0) + c, or the announced inputs; S, a room, holds their deviation from u0: (22), (35). */
    for (ptrdiff_t k = 0; k < p->steps; k++)
        for (ptrdiff_t i = 0; i < all; i++) {
            const ptrdiff_t at = k * all + i;
            p->U[at] = p->uncorrected ? p->uncorrected[at] + p->announced[at] : p->announced[at];
            p->S[at] = p->U[at] - p->u0[i];
        }
    predict(p->steps, p->n, all, p->m, p->own, p->A, p->B, p->f_d, p->K, p->S, p->effect, p->dX, p->feedback, p->dU,
            p->work);
    /* U += K dX; owned inputs without a decision are u_0,o: (24), (35). */
    for (ptrdiff_t k = 0; k < p->steps; k++) {
        for (ptrdiff_t i = 0; i < all && p->K; i++) p->U[k * all + i] += p->dU[k * all + i];
        for (ptrdiff_t i = 0; i < p->m; i++) p->U_free[k * p->m + i] = p->U[k * all + p->own[i]] = p->u0[p->own[i]];
    }
}

ptrdiff_t condense_work(ptrdiff_t steps, ptrdiff_t n, ptrdiff_t m, ptrdiff_t p, ptrdiff_t rank)
{
    const ptrdiff_t w = padded(steps * m), longest = p > rank ? p : rank;
    return (3 + m) * w + (m + 1) * padded(m) + steps * p + rank + 2 * (longest > n ? longest : n) + BLOCK;
}

/* Numbers in `kept`: effects of the decisions on states, p outputs and the root of the cost-to-go, from a full vector
   on. */
ptrdiff_t kept_work(ptrdiff_t steps, ptrdiff_t n, ptrdiff_t m, ptrdiff_t p, ptrdiff_t rank)
{
    return (n + p + rank) * padded(steps * m) + BLOCK;
}

/* Effects of the scaled decisions on states L, outputs and the root of the cost-to-go, [S(0) .. S(steps - 1)]. */
static void effects(const problem *c, const ptrdiff_t *every, double *L, double *flat, double *reached)
{
    const ptrdiff_t steps = c->steps, n = c->n, m = c->m, D = steps * m, w = padded(D);
    const ptrdiff_t p = c->outputs + c->terms + c->inputs, rank = c->rank;
    /* On states, L(a) = effect(a) Lambda: (27a). */
    memset(L, 0, (size_t)((n + p + rank) * w) * sizeof *L);
    for (ptrdiff_t i = 0; i < n; i++)
        for (ptrdiff_t a = 0; a < steps; a++)
            for (ptrdiff_t k = 0; k < m; k++) L[i * w + a * m + k] = c->effect[i * D + a * m + k] * c->scale[k];
    /* On outputs, S = C L: (25). */
    for (ptrdiff_t o = 0; o < c->outputs; o++) {
        const ptrdiff_t from = c->begin[c->chosen[o]], to = c->begin[c->chosen[o] + 1];
        combine_row(to - from, c->index + from, c->value + from, L, w, w, flat + o * w);
    }
    /* On the user's terms, S = gradient L: (48). */
    for (ptrdiff_t o = 0; o < c->terms; o++)
        combine_row(n, every, c->slope + o * n, L, w, w, flat + (c->outputs + o) * w);
    /* On the inputs of the other agents' UAVs, S(a) = K effect(a) Lambda: (36e). */
    for (ptrdiff_t o = 0; o < c->inputs; o++)
        for (ptrdiff_t a = 0; a < steps; a++)
            for (ptrdiff_t k = 0; k < m; k++)
                flat[(c->outputs + c->terms + o) * w + a * m + k] =
                    c->feedback[c->answering[o] * D + a * m + k] * c->scale[k];
    /* On the root of the cost-to-go, root L: (36d). */
    for (ptrdiff_t o = 0; o < rank; o++) combine_row(n, every, c->root + o * n, L, w, w, reached + o * w);
    /* The same without padding, for the rows of constraints. */
    for (ptrdiff_t o = 0; o < p; o++) memcpy(c->S + o * D, flat + o * w, (size_t)D * sizeof *flat);
}

/* Hessian, both triangles equal to the bit; `work` is that of `condense`.

   A prediction is block-Toeplitz: G(k) = [S(k-1) .. S(0) 0 .. 0], S(a) the effect of a decision on the outputs a + 1
   steps later: (25). So block (i, j) of the Hessian is a sum of S(a)' Q S(b) along a - b = j - i,

       H_ij = P(N_p - 2 - i, N_p - 2 - j) + S(N_p - 1 - i)' Q_f S(N_p - 1 - j) + R_ij,
       P(a, b) = S(a)' Q S(b) + P(a - 1, b - 1): (26), and 2 root' root of the cost-to-go, (36d); see
   mpc/program/horizon_and_terminal_cost.py. */
static void hessian(const problem *c, const ptrdiff_t *every, const double *flat, const double *reached, double *value,
                    double *work)
{
    const ptrdiff_t steps = c->steps, m = c->m, D = steps * m, w = padded(D), margin = padded(m), stride = c->size;
    const ptrdiff_t p = c->outputs + c->terms + c->inputs, rank = c->rank;
    double *row = work, *last = row + w, *sums = last + w;

    /* Running sums down the block diagonals, m rows of them at a time, moved to the right by one block each. */
    memset(sums, 0, (size_t)(m * (w + margin)) * sizeof *sums);
    for (ptrdiff_t a = 0; a < steps; a++) {
        const ptrdiff_t i = steps - 1 - a, columns = padded((a + 1) * m);
        for (ptrdiff_t r = 0; r < m; r++) {
            double *sum = sums + r * (w + margin), *to = c->H + (i * m + r) * stride;
            /* row = 2 S(a)' Q [S(0) .. S(a)]. */
            memset(row, 0, (size_t)columns * sizeof *row);
            for (ptrdiff_t o = 0; o < p; o++) value[o] = 2.0 * c->Q[o] * flat[o * w + a * m + r];
            combine_row(p, every, value, flat, w, columns, row);
            /* last = 2 (root S(a))' root [S(0) .. S(a)]. */
            memset(last, 0, (size_t)columns * sizeof *last);
            for (ptrdiff_t o = 0; o < rank; o++) value[o] = 2.0 * reached[o * w + a * m + r];
            combine_row(rank, every, value, reached, w, columns, last);
            /* Step N_p has the weight Q_f alone, so the sums with Q end one step earlier, without this product. */
            memmove(sum + m, sum, (size_t)(a * m) * sizeof *sum);
            memset(sum, 0, (size_t)m * sizeof *sum);
            /* H_ij = (Q_f / Q) row + last + 2 P(a - 1, b - 1). */
            for (ptrdiff_t b = 0; b <= a; b++) {
                const ptrdiff_t j = steps - 1 - b;
                for (ptrdiff_t k = 0; k < m; k++)
                    to[j * m + k] = c->terminal * row[b * m + k] + last[b * m + k] + sum[b * m + k];
            }
            /* 2 P(a, b) for the next a, and 2 R on the diagonal. */
            for (ptrdiff_t k = 0; k < (a + 1) * m; k++) sum[k] += row[k];
            to[i * m + r] += 2.0 * c->effort[r] * c->scale[r];
        }
        for (ptrdiff_t r = 0; r < m; r++) {
            /* The lower triangle, from the upper one. */
            const ptrdiff_t x = i * m + r;
            for (ptrdiff_t y = x + 1; y < D; y++) c->H[y * stride + x] = c->H[x * stride + y];
        }
    }
}

/* Hessian and gradient of the cost, doubled: 1/2 z' H z + g' z is its value: (26)-(27a). Known effects and Hessian
   stay. */
static void condense(const problem *c)
{
    const ptrdiff_t steps = c->steps, n = c->n, m = c->m, D = steps * m, w = padded(D), margin = padded(m);
    const ptrdiff_t p = c->outputs + c->terms + c->inputs, rank = c->rank, stride = c->size;
    const ptrdiff_t longest = p > rank ? p : rank, most = longest > n ? longest : n;
    double *L = (double *)(((uintptr_t)c->kept + 8 * BLOCK - 1) & ~(uintptr_t)(8 * BLOCK - 1));
    double *flat = L + n * w, *reached = flat + p * w;
    double *gradient = c->work + 2 * w + m * (w + margin), *errors = gradient + w + margin;
    double *to_go = errors + steps * p, *value = to_go + rank;
    ptrdiff_t *every = (ptrdiff_t *)(value + most);
    for (ptrdiff_t i = 0; i < most; i++) every[i] = i;
    if (!c->known) {
        effects(c, every, L, flat, reached);
        hessian(c, every, flat, reached, value, c->work);
    }

    /* 2 eta(k) = 2 Q_k (h(x_0) + C dx^free(k) - y^ref(k)) at steps k = 1 .. N_p: (27), and of the terms, (48). */
    for (ptrdiff_t k = 0; k < steps; k++) {
        const double *dx = c->dX + (k + 1) * n, *y_ref = c->y_ref + (k + 1) * c->model_outputs;
        double *error = errors + k * p;
        for (ptrdiff_t o = 0; o < c->outputs; o++) {
            const ptrdiff_t at = c->chosen[o];
            double sum = c->y[at];
            for (ptrdiff_t e = c->begin[at]; e < c->begin[at + 1]; e++) sum += c->value[e] * dx[c->index[e]];
            c->free[k * c->outputs + o] = sum;
            error[o] = sum - y_ref[at];
        }
        for (ptrdiff_t o = 0; o < c->terms; o++) error[c->outputs + o] = c->at_x0[o] + dot(n, c->slope + o * n, dx);
        for (ptrdiff_t o = 0; o < c->inputs; o++) {
            const ptrdiff_t at = c->answering[o];
            /* u(k) - u^tgt of the other agents' UAVs, (36e); step N_p has no input. */
            error[c->outputs + c->terms + o] =
                k + 1 < steps ? c->U[(k + 1) * c->all_inputs + at] - c->u_target[at] : 0.0;
        }
        for (ptrdiff_t o = 0; o < p; o++) error[o] *= 2.0 * c->Q[o] * (k + 1 < steps ? 1.0 : c->terminal);
    }

    /* g = sum_k G(k)' 2 eta(k), the last decision first: G(k)' of an error is [S(k-1) .. S(0)]' of it: (27). */
    memset(gradient, 0, (size_t)(w + margin) * sizeof *gradient);
    for (ptrdiff_t k = 0; k < steps; k++)
        combine_row(p, every, errors + k * p, flat, w, padded((k + 1) * m), gradient + (steps - 1 - k) * m);
    if (rank) {
        /* g += 2 (root L)' root (x_0 + dx(N_p) - x^ref(N_p)) + 2 L' slope: (36d). */
        const double *dx = c->dX + steps * n;
        for (ptrdiff_t i = 0; i < n; i++) value[i] = c->error[i] + dx[i];
        for (ptrdiff_t o = 0; o < rank; o++) to_go[o] = 2.0 * dot(n, c->root + o * n, value);
        combine_row(rank, every, to_go, reached, w, w, gradient);
        for (ptrdiff_t i = 0; i < n; i++) value[i] = 2.0 * c->end_slope[i];
        combine_row(n, every, value, L, w, w, gradient);
    }
    /* In the order of the decisions, with 2 Lambda R_o (u_0,o - u_o^tgt): (27). */
    for (ptrdiff_t j = 0; j < steps; j++)
        for (ptrdiff_t k = 0; k < m; k++) {
            const double effort = c->U[j * c->all_inputs + c->own[k]] - c->u_target[c->own[k]];
            c->g[j * m + k] = gradient[(steps - 1 - j) * m + k] + 2.0 * c->effort[k] * effort;
        }

    /* Slacks: Pi on the diagonal of the Hessian, pi in the gradient: (27a). */
    for (ptrdiff_t x = D; x < c->size; x++) {
        for (ptrdiff_t y = 0; y < c->size; y++) c->H[x * stride + y] = c->H[y * stride + x] = 0.0;
        c->H[x * stride + x] = c->g[x] = c->penalties[x - D];
    }
}

/* Lower block-Toeplitz matrix Gamma of an impulse response, (s, steps, m), into rows of length `stride`, (steps, s) of
   them: block (k, j) is S(k - j), (25); entries above the diagonal stay as they are. */
static void toeplitz(ptrdiff_t steps, ptrdiff_t s, ptrdiff_t m, const double *impulse, double *to, ptrdiff_t stride)
{
    for (ptrdiff_t k = 0; k < steps; k++)
        for (ptrdiff_t o = 0; o < s; o++) {
            double *row = to + (k * s + o) * stride;
            const double *effect = impulse + o * steps * m;
            for (ptrdiff_t j = 0; j <= k; j++)
                for (ptrdiff_t c = 0; c < m; c++) row[j * m + c] = effect[(k - j) * m + c];
        }
}

/* Distances of pairs of UAVs along their present direction n_ij = (r_i - r_j) / |r_i - r_j|: (29); see
   mpc/program/constraints/separation.py.

   pairs: (count, 2). r: positions, (3 N). free_: the same at steps 1 .. steps, rows of length `outputs`. effect: of
   the decisions on them, (3 N, steps, m). by: (count, steps, m), effect on the distances; distance: (steps, count). */
void distances(ptrdiff_t steps, ptrdiff_t m, ptrdiff_t count, const ptrdiff_t *pairs, ptrdiff_t outputs,
               const double *r, const double *free_, const double *effect, double *by, double *distance)
{
    const ptrdiff_t D = steps * m;
    for (ptrdiff_t pair = 0; pair < count; pair++) {
        const ptrdiff_t i = 3 * pairs[2 * pair], j = 3 * pairs[2 * pair + 1];
        double d[3] = {r[i] - r[j], r[i + 1] - r[j + 1], r[i + 2] - r[j + 2]};
        const double apart = sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
        if (apart == 0.0) d[0] = 1.0; /* two UAVs in one point have no direction; any separates them */
        else d[0] /= apart, d[1] /= apart, d[2] /= apart;
        /* n_ij' (S_i - S_j) */
        for (ptrdiff_t k = 0; k < D; k++) {
            double sum = 0.0;
            for (int x = 0; x < 3; x++) sum += d[x] * (effect[(i + x) * D + k] - effect[(j + x) * D + k]);
            by[pair * D + k] = sum;
        }
        /* n_ij' (r_i(k) - r_j(k)) without a decision */
        for (ptrdiff_t k = 0; k < steps; k++) {
            const double *at = free_ + k * outputs;
            double sum = 0.0;
            for (int x = 0; x < 3; x++) sum += d[x] * (at[i + x] - at[j + x]);
            distance[k * count + pair] = sum;
        }
    }
}

/* The QP of a prediction: cost, bounds, and rows of limited distances and angles; see mpc/program/compiled_program.py. */
void fill(const problem *p)
{
    const ptrdiff_t steps = p->steps, m = p->m, D = steps * m;
    condense(p);
    /* Bounds of the decision: u_min <= u_0,o + Lambda z(k) <= u_max, at k = 0 also within the rate: (28a). */
    for (ptrdiff_t k = 0; k < steps; k++)
        for (ptrdiff_t i = 0; i < m; i++) {
            double low = p->low[i] - p->U_free[i], high = p->high[i] - p->U_free[i];
            if (k == 0) {
                /* Inputs in force outside their bounds return at once. */
                low = low < -p->rate[i] ? -p->rate[i] : low;
                low = low > high ? high : low;
                high = high > p->rate[i] ? p->rate[i] : high;
                high = high < low ? low : high;
            }
            p->lower[k * m + i] = low / p->scale[i];
            p->upper[k * m + i] = high / p->scale[i];
        }
    double *rows = p->rows + (steps - 1) * m * p->size, *distance = p->signals + p->pairs * D;
    double *lower = p->row_lower + (steps - 1) * m, *upper = p->row_upper + (steps - 1) * m;
    /* n_ij' (r_i(k) - r_j(k)) + epsilon >= d_min: (29). The rows of the rates, constant, stand ahead of these. */
    if (p->pairs) {
        distances(steps, m, p->pairs, p->pair, p->outputs, p->y, p->free, p->S, p->signals, distance);
        toeplitz(steps, p->pairs, m, p->signals, rows, p->size);
        for (ptrdiff_t i = 0; i < steps * p->pairs; i++) lower[i] = p->separation - distance[i];
        rows += steps * p->pairs * p->size, lower += steps * p->pairs, upper += steps * p->pairs;
    }
    /* -theta_max - epsilon <= theta_0 + dtheta(k) <= theta_max + epsilon, first the upper rows, then the lower ones:
       (29a). */
    if (p->angles) {
        const ptrdiff_t half = steps * p->angles;
        for (ptrdiff_t a = 0; a < p->angles && !p->known; a++)
            for (ptrdiff_t j = 0; j < D; j++) p->signals[a * D + j] = p->effect[p->angle[a] * D + j] * p->scale[j % m];
        if (!p->known) {
            toeplitz(steps, p->angles, m, p->signals, rows, p->size);
            toeplitz(steps, p->angles, m, p->signals, rows + half * p->size, p->size);
        }
        for (ptrdiff_t k = 0; k < steps; k++)
            for (ptrdiff_t a = 0; a < p->angles; a++) {
                const double angle = p->x0[p->angle[a]] + p->dX[(k + 1) * p->n + p->angle[a]];
                upper[k * p->angles + a] = p->tilt - angle;
                lower[half + k * p->angles + a] = -p->tilt - angle;
            }
    }
}

/* Plan from the scaled decision z, with a weight of the new corrections: (36a); see `relax`. */
void conclude(const problem *p, const double *z, double w, double *U, double *c)
{
    relax(p->steps, p->m, p->all_inputs, p->own, z, p->scale, p->U_free, p->uncorrected, p->announced, p->dU,
          p->feedback, w, p->low, p->high, p->rate, U, c, p->work);
}

#define TURN 6.283185307179586476925286766559 /* 2 pi */

/* The law of a UAV alone, with what it follows from; the state of the team x is that of model/state.py. */
typedef struct {
    double rho[3], length;              /* attachment point, payload frame, and length of the rod */
    double masses[3];                   /* that a force moves, by axis */
    double position, velocity, swing;   /* gains of the position loop */
    double steepest;                    /* largest change of roll and pitch */
    double stiffness[9], damping[9];    /* of the attitude loop */
} alone_law;

/* What it follows at an instant: a motion, and the inputs that belong to it. */
typedef struct {
    double position[3], velocity[3], Theta[3], omega[3], rod[3], swing[3];
    double force[3], turning[3];
} alone_setpoint;

/* R = Rz(yaw) Ry(pitch) Rx(roll): (2). */
static void rotation(const double *Theta, double *R)
{
    const double cr = cos(Theta[0]), cp = cos(Theta[1]), cy = cos(Theta[2]);
    const double sr = sin(Theta[0]), sp = sin(Theta[1]), sy = sin(Theta[2]);
    R[0] = cy * cp, R[1] = cy * sp * sr - sy * cr, R[2] = cy * sp * cr + sy * sr;
    R[3] = sy * cp, R[4] = sy * sp * sr + cy * cr, R[5] = sy * sp * cr - cy * sr;
    R[6] = -sp, R[7] = cp * sr, R[8] = cp * cr;
}

/* to = M a, a matrix (3, 3). */
static void times(const double *M, const double *a, double *to)
{
    for (int i = 0; i < 3; i++) to[i] = M[3 * i] * a[0] + M[3 * i + 1] * a[1] + M[3 * i + 2] * a[2];
}

/* to = a x b. */
static void cross(const double *a, const double *b, double *to)
{
    to[0] = a[1] * b[2] - a[2] * b[1];
    to[1] = a[2] * b[0] - a[0] * b[2];
    to[2] = a[0] * b[1] - a[1] * b[0];
}

static double within(double value, double largest) { return fmin(fmax(value, -largest), largest); }

/* Roll and pitch whose thrust has the direction of a force, at a yaw: (31b). */
static void attitude(const double *force, double yaw, double *roll, double *pitch)
{
    const double strength = sqrt(force[0] * force[0] + force[1] * force[1] + force[2] * force[2]);
    const double forward = cos(yaw) * force[0] + sin(yaw) * force[1];
    const double right = cos(yaw) * force[1] - sin(yaw) * force[0];
    *roll = strength > 0.0 ? asin(within(right / strength, 1.0)) : 0.0; /* beyond 1 by rounding */
    *pitch = strength > 0.0 ? atan2(-forward, -force[2]) : 0.0;
}

/* Inputs u of a UAV alone at a state of the team, before limits: (31a), (31b). `own` is its part of the state,
   `held` the force of its integral. */
void alone_inputs(const double *x, const double *own, const alone_law *law, const alone_setpoint *setpoint,
                  const double *held, double *u)
{
    const double *v0 = x + 3, *Theta0 = x + 6, *omega0 = x + 9;
    const double *e = own, *rod_rate = own + 3, *Theta = own + 6, *omega = own + 9;
    double R0[9], R[9];
    rotation(Theta0, R0);
    rotation(Theta, R);

    /* Its motion: position r0 + R0 (rho - l e), velocity R0 (v0 + omega0 x rho - l Omega x e), (1), (39). */
    double rod_P[3], swing_P[3], velocity_P[3], to_uav_P[3], to_uav[3], velocity[3], swing[3];
    for (int i = 0; i < 3; i++) rod_P[i] = law->length * e[i];
    cross(rod_rate, rod_P, swing_P);
    cross(omega0, law->rho, velocity_P);
    for (int i = 0; i < 3; i++) {
        velocity_P[i] += v0[i] - swing_P[i];
        to_uav_P[i] = law->rho[i] - rod_P[i];
    }
    times(R0, to_uav_P, to_uav);
    times(R0, velocity_P, velocity);
    times(R0, swing_P, swing);

    /* F = F_ref + M (k_p (p_ref - p) + k_v (v_ref - v) - k_s (s - s_ref)) + g, the swing s level: (31a). */
    double force[3];
    for (int i = 0; i < 3; i++) {
        const double error = setpoint->position[i] - (x[i] + to_uav[i]);
        const double slower = setpoint->velocity[i] - velocity[i];
        const double swinging = i < 2 ? swing[i] - setpoint->swing[i] : 0.0;
        const double acceleration = law->position * error + law->velocity * slower - law->swing * swinging;
        force[i] = setpoint->force[i] + law->masses[i] * acceleration + held[i];
    }

    /* The attitude whose thrust has that direction, near the one of the setpoint; thrust along the own axis: (31b). */
    double roll, pitch, roll_ref, pitch_ref;
    attitude(force, Theta[2], &roll, &pitch);
    attitude(setpoint->force, Theta[2], &roll_ref, &pitch_ref);
    const double error[3] = {Theta[0] - (roll_ref + within(roll - roll_ref, law->steepest)),
                             Theta[1] - (pitch_ref + within(pitch - pitch_ref, law->steepest)),
                             remainder(Theta[2] - setpoint->Theta[2], TURN)};
    double turned_faster[3], stiff[3], damped[3];
    for (int i = 0; i < 3; i++) turned_faster[i] = omega[i] - setpoint->omega[i];
    times(law->stiffness, error, stiff);
    times(law->damping, turned_faster, damped);
    u[0] = -(R[2] * force[0] + R[5] * force[1] + R[8] * force[2]);
    for (int i = 0; i < 3; i++) u[1 + i] = setpoint->turning[i] - stiff[i] - damped[i];
}

#define PIVOTS 16 /* rows of the factor per update of the remaining matrix */

/* Cholesky factor H = U' U in place, U_ii = sqrt(H_ii - sum_k U_ki^2), U_ij = (H_ij - sum_k U_ki U_kj) / U_ii; rows of
   length `width` (a multiple of BLOCK, zero beyond n); undefined below the diagonal.
   Returns 0 when H is not positive definite. */
static int factorise(ptrdiff_t n, ptrdiff_t width, double *H)
{
    ptrdiff_t index[PIVOTS];
    double value[PIVOTS];
    for (ptrdiff_t from = 0; from < n; from += PIVOTS) {
        const ptrdiff_t to = from + PIVOTS < n ? from + PIVOTS : n;
        /* Rows from .. to are finished; those behind lose the products with them. */
        for (ptrdiff_t i = from; i < n; i++) {
            const ptrdiff_t terms = (i < to ? i : to) - from, first = i / BLOCK * BLOCK;
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
    /* U' y = b */
    for (ptrdiff_t k = 0; k < n; k++) {
        const double *row = U + k * width;
        x[k] /= row[k];
        for (ptrdiff_t j = k + 1; j < n; j++) x[j] -= row[j] * x[k];
    }
    /* U x = y */
    for (ptrdiff_t k = n - 1; k >= 0; k--) {
        const double *row = U + k * width;
        lanes sum[BLOCK / LANES];
        for (int v = 0; v < BLOCK / LANES; v++) sum[v] = splat(0.0);
        double rest = 0.0;
        ptrdiff_t j = k + 1;
        for (; j < n && j % BLOCK; j++) rest += row[j] * x[j];
        for (; j + BLOCK <= n; j += BLOCK)
            for (int v = 0; v < BLOCK / LANES; v++) sum[v] += VECTOR(row + j + v * LANES) * VECTOR(x + j + v * LANES);
        for (; j < n; j++) rest += row[j] * x[j];
        for (int i = 0; i < BLOCK; i++) rest += sum[i / LANES][i % LANES];
        x[k] = (x[k] - rest) / row[k];
    }
}

ptrdiff_t within_bounds_work(ptrdiff_t n, ptrdiff_t rows)
{
    const ptrdiff_t solving = n * padded(n) + 2 * padded(n) + 2 * n;
    return solving > rows + n ? solving : rows + n;
}

/* minimise 1/2 z' H z + g' z within bounds by a primal-dual active-set method (Hintermueller, Ito, Kunisch 2003); see
   mpc/program/qp_solvers.py. With F the free and A the held coordinates of a guess,

       H_FF z_F = -g_F - H_FA z_A,   mu_A = -(g + H z)_A,   mu_F = 0,

   and coordinates beyond their bounds are held in the next guess, those whose multiplier points inwards are freed.

   Returns the number of guesses, or 0 if there were too many or H is not positive definite. */
static int within_bounds(ptrdiff_t n, const double *H, const double *g, const double *lower, const double *upper,
                         int most, double *z, double *multipliers, double *work)
{
    double *U = work, *x = U + n * padded(n);
    ptrdiff_t *free_ = (ptrdiff_t *)(x + 2 * padded(n)), *held = free_ + n; /* held: -1 at the lower bound, 1, or 0 */
    /* The first guess is that of z = 0: bounds beyond which the descent from it leads are held. */
    for (ptrdiff_t i = 0; i < n; i++) held[i] = lower[i] >= 0.0 && g[i] > 0.0 ? -1 : upper[i] <= 0.0 && g[i] < 0.0;
    for (int guess = 1; guess <= most; guess++) {
        ptrdiff_t free_count = 0;
        for (ptrdiff_t i = 0; i < n; i++) {
            z[i] = held[i] < 0 ? lower[i] : held[i] > 0 ? upper[i] : 0.0;
            if (!held[i]) free_[free_count++] = i;
        }
        /* H_FF and -g_F - H_FA z_A */
        const ptrdiff_t width = padded(free_count);
        memset(x, 0, (size_t)width * sizeof *x);
        for (ptrdiff_t a = 0; a < free_count; a++) {
            const double *row = H + free_[a] * n;
            double *to = U + a * width, pull = -g[free_[a]];
            for (ptrdiff_t b = 0; b < free_count; b++) to[b] = row[free_[b]];
            for (ptrdiff_t b = free_count; b < width; b++) to[b] = 0.0;
            if (free_count < n)
                for (ptrdiff_t j = 0; j < n; j++) pull -= row[j] * z[j];
            x[a] = pull;
        }
        if (!factorise(free_count, width, U)) return 0;
        substitute(free_count, width, U, x);
        for (ptrdiff_t a = 0; a < free_count; a++) z[free_[a]] = x[a];
        /* mu, and the coordinates that the next guess holds */
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

/* Violations of bounds, max(low - value, value - high), and of complementarity, |xi chi|, by one value: (28). */
static void judge(double value, double multiplier, double low, double high, double *outside, double *slackness)
{
    *outside = larger(*outside, larger(low - value, value - high));
    if (multiplier > 0.0) *slackness = larger(*slackness, fabs(multiplier * (isinf(high) ? 1.0 : high - value)));
    else if (multiplier != 0.0) *slackness = larger(*slackness, fabs(multiplier * (isinf(low) ? 1.0 : value - low)));
}

/* Karush-Kuhn-Tucker residuals (28); see mpc/program/quadratic_program.py. found: stationarity, primal, complementarity. */
void residuals(ptrdiff_t n, ptrdiff_t rows, const double *H, const double *g, const double *lower, const double *upper,
               const double *A, const double *row_lower, const double *row_upper, const double *z,
               const double *bound_multipliers, const double *row_multipliers, double *found, double *work)
{
    double outside = 0.0, slackness = 0.0, slope = 0.0, of_g = 0.0, of_z = 0.0, objective = 0.0, *push = work;
    /* push = A_z' nu; rows that leave their bounds, and |nu chi|. */
    memset(push, 0, (size_t)n * sizeof *push);
    for (ptrdiff_t r = 0; r < rows; r++) {
        const double *row = A + r * n;
        judge(dot(n, row, z), row_multipliers[r], row_lower[r], row_upper[r], &outside, &slackness);
        if (row_multipliers[r] != 0.0)
            for (ptrdiff_t j = 0; j < n; j++) push[j] += row_multipliers[r] * row[j];
    }
    /* |H_z z + g_z + mu + A_z' nu|, coordinates that leave their bounds, |mu chi|, and the norms of (28). */
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

/* Whether all numbers are finite. */
static int all_finite(ptrdiff_t n, const double *a)
{
    lanes sum = splat(0.0); /* x - x is nan for an infinite x */
    double rest = 0.0;
    ptrdiff_t i = 0;
    for (; i + LANES <= n; i += LANES) sum += VECTOR(a + i) - VECTOR(a + i);
    for (; i < n; i++) rest += a[i] - a[i];
    for (int v = 0; v < LANES; v++) rest += sum[v];
    return rest == 0.0;
}

/* A QP by its bounds alone, and the residuals of that solution in the whole QP; `found` as in `residuals`.

   Returns the number of guesses; 0 if there is no such solution or rows are equalities, -1 if H or g is not finite. */
int solve_within_bounds(ptrdiff_t n, ptrdiff_t rows, const double *H, const double *g, const double *lower,
                        const double *upper, const double *A, const double *row_lower, const double *row_upper,
                        int most, double *z, double *multipliers, double *found, double *work)
{
    if (!all_finite(n, g) || !all_finite(n * n, H)) return -1;
    for (ptrdiff_t r = 0; r < rows; r++)
        if (row_lower[r] == row_upper[r]) return 0;
    const int guesses = within_bounds(n, H, g, lower, upper, most, z, multipliers, work);
    if (!guesses) return 0;
    double *none = work; /* the multipliers of the rows */
    memset(none, 0, (size_t)rows * sizeof *none);
    residuals(n, rows, H, g, lower, upper, A, row_lower, row_upper, z, multipliers, none, found, work + rows);
    return guesses;
}
