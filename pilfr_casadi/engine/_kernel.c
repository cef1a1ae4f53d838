/* Time loops around a generated step: simulation, and the matrix-form sensitivity recursion.
 *
 * They are compiled once a machine. A model's own library holds its generated code and a `model_t` (_kernel.h) that says
 * where everything is. Of `stride` steps the first one's outputs are kept; `length` counts the steps.
 *
 * Terms whose value is zero are dropped at run time, and a memory row that only keeps itself is not touched: a play's slope
 * changes only while it slips. This is what makes the recursion cheap with many operators.
 */
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define SLOTS 64 /* more than the arguments, results and whole numbers of a generated function */
#define LANE 8  /* columns are padded to a multiple of this */
#define TILE 64 /* columns worked on at a time, so that the rows read again and again stay in the nearest cache */

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
static void rows(double *out, long ld, int n_rows, const table_t *table, const double *value,
                 const double *const *source, const long *column, int keep, active_t *active, span_t *span) {
    const int *row = table->row, *direct_row = table->direct_row;
    const term_t *terms = table->term;
    const direct_t *direct = table->direct;
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

/* state (n_x + n_s) is advanced in place; z and w may be null. */
int pilfr_simulate(const model_t *m, long length, const double *u, const double *p, double *state, double *y, double *z,
                   double *w) {
    const int n = m->n_x + m->n_s;
    const int n_c = m->at_computed - m->at_c;
    double *work = malloc(sizeof(double) * (m->sz_w + n + 2 * m->n_z + m->n_y + m->n_fixed + 1 + n_c));
    if (!work) return 1;
    double *next = work + m->sz_w, *z_k = next + n, *w_k = z_k + m->n_z, *y_k = w_k + m->n_z, *fixed = y_k + m->n_y;
    double *stages = fixed + m->n_fixed + 1;
    const double *arg[SLOTS];
    double *res[SLOTS];
    long long iw[SLOTS];
    arg[0] = p; res[0] = fixed;
    m->fixed(arg, res, iw, work, 0);
    for (long k = 0; k < length; ++k) {
        arg[0] = state; arg[1] = state + m->n_x; arg[2] = u + k * m->n_u; arg[3] = p; arg[4] = fixed;
        const int kept = k % m->stride == 0;
        const long i = k / m->stride;
        res[0] = next; res[1] = next + m->n_x; res[2] = kept ? y + i * m->n_y : y_k;
        res[3] = z && kept ? z + i * m->n_z : z_k; res[4] = w && kept ? w + i * m->n_z : w_k; res[5] = stages;
        m->step(arg, res, iw, work, 0);
        memcpy(state, next, sizeof(double) * n);
    }
    free(work);
    return 0;
}

/* Derivatives with respect to n_c columns: slope ((n_x + n_s) x n_c, row by row) is advanced in place with the state, jac is
 * (length / stride * n_y) x n_c; column[i] is the column of parameter i, or -1. */
int pilfr_sensitivity(const model_t *m, long length, const double *u, const double *p, double *state, double *slope,
                      const long *column, long n_c, double *y, double *jac) {
    enum { LINE = 64 };
    const int n_x = m->n_x, n_s = m->n_s, n_z = m->n_z, n_y = m->n_y, n_u = m->n_u, n = n_x + n_s;
    const int n_direct = m->n_direct_rows;
    const int n_rows = n + n_x + 2 * n_z + n_y + (m->keeps ? 0 : n_s) + n_direct + 1;
    const long ld = (n_c + LANE - 1) / LANE * LANE;
    const size_t doubles = (size_t)n_rows * ld + m->n_values + n + n_y + m->sz_w, terms = m->n_terms + 1, spans = n + n_z + n_y + 1;
    const size_t scratch = sizeof(active_t) * terms + sizeof(long) * m->n_direct + sizeof(span_t) * spans;
    char *memory = malloc(LINE + sizeof(double) * doubles + scratch);
    if (!memory) return 1;
    double *x = (double *)(((uintptr_t)memory + LINE - 1) / LINE * LINE), *s = x + n_x * ld, *x_next = s + n_s * ld;
    double *z = x_next + n_x * ld, *w = z + n_z * ld, *y_k = w + n_z * ld, *s_next = m->keeps ? s : y_k + n_y * ld;
    double *value = x + n_rows * ld, *next = value + m->n_values, *work = next + n + n_y;
    active_t *active = (active_t *)(work + m->sz_w);
    long *where = (long *)(active + terms);
    span_t *span = (span_t *)(where + m->n_direct);
    double *direct = x + (n_rows - n_direct - 1) * ld; /* and a row for what no column is wanted of */
    double *at_p = value + m->at_p, *at_fixed = value + m->at_fixed, *at_u = value + m->at_u, *at_x = value + m->at_x;
    double *at_s = value + m->at_s, *at_z = value + m->at_z, *at_w = value + m->at_w, *at_c = value + m->at_c;
    const double *arg[SLOTS], *source[4];
    double *res[SLOTS];
    long long iw[SLOTS];

    memset(x, 0, sizeof(double) * n_rows * ld);
    for (int i = 0; i < n; ++i) memcpy(x + i * ld, slope + i * n_c, sizeof(double) * n_c);
    memcpy(value, m->constants, sizeof(double) * m->at_p);
    memcpy(at_p, p, sizeof(double) * m->n_p);
    memcpy(at_x, state, sizeof(double) * n);
    arg[0] = at_p; res[0] = at_fixed;
    m->fixed(arg, res, iw, work, 0);
    for (int t = 0; t < m->n_direct; ++t) {
        const long j = column[m->direct[t].parameter];
        where[t] = j < 0 ? n_direct * ld : m->direct[t].row * ld + j;
    }
#define ROWS_OF(t, out, count, keep) rows(out, ld, count, &m->t, value, source, column, keep, active, span)
    for (long k = 0; k < length; ++k) {
        memcpy(at_u, u + k * n_u, sizeof(double) * n_u);
        arg[0] = at_x; arg[1] = at_s; arg[2] = at_u; arg[3] = at_p; arg[4] = at_fixed;
        const int kept = k % m->stride == 0;
        const long sample = k / m->stride;
        res[0] = next; res[1] = next + n_x; res[2] = kept ? y + sample * n_y : next + n; res[3] = at_z; res[4] = at_w; res[5] = at_c;
        m->step(arg, res, iw, work, 0);
        arg[0] = at_x; arg[1] = at_s; arg[2] = at_z; arg[3] = at_w; arg[4] = at_c; arg[5] = at_u; arg[6] = at_p;
        arg[7] = at_fixed;
        res[0] = value + m->at_computed;
        m->computed(arg, res, iw, work, 0);
        if (m->slopes) {
            for (int t = 0; t < m->n_direct; ++t) direct[where[t]] = value[m->direct[t].value];
            m->slopes(value, x, s, direct, s_next, x_next, kept ? y_k : 0, ld);
        } else {
            source[0] = x; source[1] = s; source[2] = z; source[3] = w;
            ROWS_OF(of_z, z, n_z, 0);
            ROWS_OF(of_w, w, n_z, 0);
            ROWS_OF(of_s, s_next, n_s, m->keeps);
            if (kept) ROWS_OF(of_y, y_k, n_y, 0);
            ROWS_OF(of_x, x_next, n_x, 0);
        }
        for (int i = 0; kept && i < n_y; ++i) memcpy(jac + (sample * n_y + i) * n_c, y_k + i * ld, sizeof(double) * n_c);
        double *swap = x; x = x_next; x_next = swap;
        if (!m->keeps) { swap = s; s = s_next; s_next = swap; }
        memcpy(at_x, next, sizeof(double) * n);
    }
    for (int i = 0; i < n; ++i) memcpy(slope + i * n_c, (i < n_x ? x + i * ld : s + (i - n_x) * ld), sizeof(double) * n_c);
    memcpy(state, at_x, sizeof(double) * n);
    free(memory);
    return 0;
}
