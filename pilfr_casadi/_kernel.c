/* Time loops around the generated step: simulation, and the matrix-form sensitivity recursion.
 *
 * The generated part above defines pilfr_fixed(), pilfr_step(), pilfr_computed(), the sizes N_X N_S N_Z N_Y N_U N_P N_TERMS, and
 * where the values of one sample begin in their stack: AT_CONSTANT AT_P AT_FIXED AT_U AT_X AT_S AT_Z AT_W AT_COMPUTED, N_VALUES.
 * Of STRIDE steps the first one's outputs are kept; `length` counts the steps.
 * A row of slopes is a sum of terms. TERM_<t>[ROW_<t>[i]] .. TERM_<t>[ROW_<t>[i+1]] are those of row i of target t, each
 * {source, index, value}: the row `index` of source 0 x, 1 s, 2 z, 3 w, times a value of the stack; DIRECT_<t> likewise
 * {parameter, value}: the value goes to the parameter's column.
 *
 * Terms whose value is zero are dropped at run time, and a memory row that only keeps itself is not touched: a play's slope
 * changes only while it slips. This is what makes the recursion cheap with many operators.
 */
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define LANE 8  /* columns are padded to a multiple of this */
#define TILE 64 /* columns worked on at a time, so that the rows read again and again stay in the nearest cache */

#if defined(__AVX512F__)
#define WIDTH 8 /* numbers in one register */
#elif defined(__AVX__)
#define WIDTH 4
#else
#define WIDTH 2
#endif
typedef double lane_t __attribute__((vector_size(sizeof(double) * WIDTH), aligned(8), may_alias));
typedef struct { const double *row; double value; } active_t;
typedef struct { int first, last, row; } span_t;

/* out[from..to) = sum of the terms; out may be one of their rows. */
static void combine(double *out, const active_t *terms, int n, long from, long to) {
    long j = from;
    for (; j + 4 * WIDTH <= to; j += 4 * WIDTH) {
        lane_t a = {0}, b = {0}, c = {0}, d = {0};
        for (int t = 0; t < n; ++t) {
            const lane_t *r = (const lane_t *)(terms[t].row + j);
            const double v = terms[t].value;
            a += v * r[0]; b += v * r[1]; c += v * r[2]; d += v * r[3];
        }
        lane_t *o = (lane_t *)(out + j);
        o[0] = a; o[1] = b; o[2] = c; o[3] = d;
    }
    for (; j < to; j += WIDTH) {
        lane_t a = {0};
        for (int t = 0; t < n; ++t) a += terms[t].value * *(const lane_t *)(terms[t].row + j);
        *(lane_t *)(out + j) = a;
    }
}

/* All rows of one target. `active` and `span` are scratch for its terms and rows; with `keep`, row i of the target is row i
 * of source 1 and stays as it is where that is its only term. */
static void rows(double *out, long ld, int n_rows, const int *row, const term_t *terms, const int *direct_row,
                 const direct_t *direct, const double *value, const double *const *source, const long *column, int keep,
                 active_t *active, span_t *span) {
    int n = 0, m = 0;
    for (int i = 0; i < n_rows; ++i) {
        const int first = n;
        int moves = !keep;
        for (int t = row[i]; t < row[i + 1]; ++t) {
            const double v = value[terms[t].value];
            if (v == 0.0) continue;
            moves |= v != 1.0 || terms[t].source != 1 || terms[t].index != i;
            active[n].row = source[terms[t].source] + terms[t].index * ld;
            active[n++].value = v;
        }
        if (moves || n == first) span[m++] = (span_t){first, n, i};
        else n = first;
    }
    for (long from = 0; from < ld; from += TILE) {
        const long to = from + TILE < ld ? from + TILE : ld;
        for (int i = 0; i < m; ++i) combine(out + span[i].row * ld, active + span[i].first, span[i].last - span[i].first, from, to);
    }
    for (int i = 0; i < n_rows; ++i)
        for (int t = direct_row[i]; t < direct_row[i + 1]; ++t) {
            const long j = column[direct[t].parameter];
            if (j >= 0) out[i * ld + j] += value[direct[t].value];
        }
}

/* state (N_X + N_S) is advanced in place; z and w may be null. */
int pilfr_simulate(long length, const double *u, const double *p, double *state, double *y, double *z, double *w) {
    double *work = malloc(sizeof(double) * (SZ_W + N_X + N_S + 2 * N_Z + N_Y + N_FIXED + 1));
    if (!work) return 1;
    double *next = work + SZ_W, *z_k = next + N_X + N_S, *w_k = z_k + N_Z, *y_k = w_k + N_Z, *fixed = y_k + N_Y;
    casadi_int iw[SZ_IW];
    const double *arg[SZ_ARG];
    double *res[SZ_RES];
    arg[0] = p; res[0] = fixed;
    pilfr_fixed(arg, res, iw, work, 0);
    for (long k = 0; k < length; ++k) {
        arg[0] = state; arg[1] = state + N_X; arg[2] = u + k * N_U; arg[3] = p; arg[4] = fixed;
        const int kept = k % STRIDE == 0;
        const long i = k / STRIDE;
        res[0] = next; res[1] = next + N_X; res[2] = kept ? y + i * N_Y : y_k;
        res[3] = z && kept ? z + i * N_Z : z_k; res[4] = w && kept ? w + i * N_Z : w_k;
        pilfr_step(arg, res, iw, work, 0);
        memcpy(state, next, sizeof(double) * (N_X + N_S));
    }
    free(work);
    return 0;
}

/* Derivatives with respect to n_c columns: slope ((N_X + N_S) x n_c, row by row) is advanced in place with the state, jac is
 * (length / STRIDE * N_Y) x n_c; column[i] is the column of parameter i, or -1. */
int pilfr_sensitivity(long length, const double *u, const double *p, double *state, double *slope, const long *column,
                      long n_c, double *y, double *jac) {
    enum { N = N_X + N_S, ROWS = N + N_X + 2 * N_Z + N_Y + (KEEPS ? 0 : N_S), LINE = 64 };
    const long ld = (n_c + LANE - 1) / LANE * LANE;
    const size_t doubles = (size_t)ROWS * ld + N_VALUES + N + N_Y + SZ_W, terms = N_TERMS + 1, spans = N + N_Z + N_Y + 1;
    char *memory = malloc(LINE + sizeof(double) * doubles + sizeof(active_t) * terms + sizeof(span_t) * spans);
    if (!memory) return 1;
    double *x = (double *)(((uintptr_t)memory + LINE - 1) / LINE * LINE), *s = x + N_X * ld, *x_next = s + N_S * ld;
    double *z = x_next + N_X * ld, *w = z + N_Z * ld, *y_k = w + N_Z * ld, *s_next = KEEPS ? s : y_k + N_Y * ld;
    double *value = x + ROWS * ld, *next = value + N_VALUES, *work = next + N + N_Y;
    active_t *active = (active_t *)(work + SZ_W);
    span_t *span = (span_t *)(active + terms);
    casadi_int iw[SZ_IW];
    const double *arg[SZ_ARG], *source[4];
    double *res[SZ_RES];

    memset(x, 0, sizeof(double) * ROWS * ld);
    for (int i = 0; i < N; ++i) memcpy(x + i * ld, slope + i * n_c, sizeof(double) * n_c);
    memcpy(value + AT_CONSTANT, CONSTANTS, sizeof(double) * (AT_P - AT_CONSTANT));
    memcpy(value + AT_P, p, sizeof(double) * N_P);
    memcpy(value + AT_X, state, sizeof(double) * N);
    arg[0] = value + AT_P; res[0] = value + AT_FIXED;
    pilfr_fixed(arg, res, iw, work, 0);
#define ROWS_OF(t, out, n, keep) \
    rows(out, ld, n, ROW_##t, TERM_##t, DIRECT_ROW_##t, DIRECT_##t, value, source, column, keep, active, span)
    for (long k = 0; k < length; ++k) {
        memcpy(value + AT_U, u + k * N_U, sizeof(double) * N_U);
        arg[0] = value + AT_X; arg[1] = value + AT_S; arg[2] = value + AT_U; arg[3] = value + AT_P; arg[4] = value + AT_FIXED;
        const int kept = k % STRIDE == 0;
        const long sample = k / STRIDE;
        res[0] = next; res[1] = next + N_X; res[2] = kept ? y + sample * N_Y : next + N; res[3] = value + AT_Z; res[4] = value + AT_W;
        pilfr_step(arg, res, iw, work, 0);
        arg[0] = value + AT_X; arg[1] = value + AT_S; arg[2] = value + AT_Z; arg[3] = value + AT_W;
        arg[4] = value + AT_U; arg[5] = value + AT_P; arg[6] = value + AT_FIXED;
        res[0] = value + AT_COMPUTED;
        pilfr_computed(arg, res, iw, work, 0);
        source[0] = x; source[1] = s; source[2] = z; source[3] = w;
        ROWS_OF(z, z, N_Z, 0);
        ROWS_OF(w, w, N_Z, 0);
        ROWS_OF(s, s_next, N_S, KEEPS);
        if (kept) ROWS_OF(y, y_k, N_Y, 0);
        ROWS_OF(x, x_next, N_X, 0);
        for (int i = 0; kept && i < N_Y; ++i) memcpy(jac + (sample * N_Y + i) * n_c, y_k + i * ld, sizeof(double) * n_c);
        double *swap = x; x = x_next; x_next = swap;
        if (!KEEPS) { swap = s; s = s_next; s_next = swap; }
        memcpy(value + AT_X, next, sizeof(double) * N);
    }
    for (int i = 0; i < N; ++i) memcpy(slope + i * n_c, (i < N_X ? x + i * ld : s + (i - N_X) * ld), sizeof(double) * n_c);
    memcpy(state, value + AT_X, sizeof(double) * N);
    free(memory);
    return 0;
}
