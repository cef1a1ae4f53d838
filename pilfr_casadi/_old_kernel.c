/* Time loops around the generated step: simulation, and the matrix-form sensitivity recursion.
 *
 * The generated part above defines the sizes N_X N_S N_Z N_Y N_U N_P N_NZ, pilfr_step(), pilfr_linear(), and for each target row the
 * list of its terms: ROW_<t>[i] .. ROW_<t>[i+1] index TERM_<t>, each term {source, index, nonzero}. Sources are
 * 0 x, 1 s, 2 z, 3 w (rows of slopes) and 4 p (one entry in the parameter's column).
 *
 * Terms whose coefficient is zero are dropped at run time, and a memory row that only keeps itself is not touched: a
 * play's slope changes only while it slips. This is what makes the recursion cheap with many operators.
 */
#include <string.h>

#define LANE 8

typedef struct { const double *row; double c; } active_t;

static void combine(double *restrict out, const active_t *terms, int n, long ld) {
    for (long j = 0; j < ld; j += LANE) {
        double acc[LANE] = {0};
        for (int t = 0; t < n; ++t) {
            const double c = terms[t].c;
            const double *restrict r = terms[t].row + j;
            for (int k = 0; k < LANE; ++k) acc[k] += c * r[k];
        }
        for (int k = 0; k < LANE; ++k) out[j + k] = acc[k];
    }
}

static void rows(double *out, long ld, int n_rows, const int *first, const term_t *terms, const double *nz,
                 const double *const *source, const long *col, int keep) {
    active_t active[MAX_TERMS + 1];
    for (int i = 0; i < n_rows; ++i) {
        int n = 0, direct = 0;
        for (int t = first[i]; t < first[i + 1]; ++t) {
            const double c = nz[terms[t].nonzero];
            if (c == 0.0) continue;
            if (terms[t].source == 4) { direct += col[terms[t].index] >= 0; continue; }
            active[n].row = source[terms[t].source] + terms[t].index * ld;
            active[n++].c = c;
        }
        double *row = out + i * ld;
        if (keep && n == 1 && active[0].c == 1.0 && active[0].row == row && !direct) continue;
        combine(row, active, n, ld);
        if (!direct) continue;
        for (int t = first[i]; t < first[i + 1]; ++t)
            if (terms[t].source == 4 && col[terms[t].index] >= 0) row[col[terms[t].index]] += nz[terms[t].nonzero];
    }
}

/* state (N_X + N_S) is advanced in place; z and w may be null. */
int pilfr_simulate(long length, const double *u, const double *p, double *state, double *y, double *z, double *w) {
    casadi_int iw[SZ_IW];
    double work[SZ_W], next[N_X + N_S + 1], z_k[N_Z + 1], w_k[N_Z + 1];
    const double *arg[SZ_ARG];
    double *res[SZ_RES];
    for (long k = 0; k < length; ++k) {
        arg[0] = state; arg[1] = state + N_X; arg[2] = u + k * N_U; arg[3] = p;
        res[0] = next; res[1] = next + N_X; res[2] = y + k * N_Y;
        res[3] = z ? z + k * N_Z : z_k; res[4] = w ? w + k * N_Z : w_k;
        pilfr_step(arg, res, iw, work, 0);
        memcpy(state, next, sizeof(double) * (N_X + N_S));
    }
    return 0;
}

/* slope ((N_X + N_S) x ld, row by row) is advanced in place; jac is (length * N_Y) x ld; scratch holds
 * (2 * N_Z + N_X + N_S * !DIAGONAL) * ld numbers; ld is a multiple of LANE. */
int pilfr_sensitivity(long length, const double *u, const double *p, double *state, double *slope, const long *col, long ld,
                      double *y, double *jac, double *scratch) {
    casadi_int iw[SZ_IW];
    double work[SZ_W], next[N_X + N_S + 1], nz[N_NZ + 1];
    const double *arg[SZ_ARG];
    double *res[SZ_RES];
    double *x_rows = slope, *s_rows = slope + N_X * ld;
    double *z_rows = scratch, *w_rows = z_rows + N_Z * ld, *x_new = w_rows + N_Z * ld, *s_new = x_new + N_X * ld;
    const double *source[4] = {x_rows, s_rows, z_rows, w_rows};
    for (long k = 0; k < length; ++k) {
        arg[0] = state; arg[1] = state + N_X; arg[2] = u + k * N_U; arg[3] = p;
        res[0] = next; res[1] = next + N_X; res[2] = y + k * N_Y; res[3] = nz;
        pilfr_linear(arg, res, iw, work, 0);
        rows(z_rows, ld, N_Z, ROW_z, TERM_z, nz, source, col, 0);
        rows(w_rows, ld, N_Z, ROW_w, TERM_w, nz, source, col, 0);
        if (DIAGONAL) {
            rows(s_rows, ld, N_S, ROW_s, TERM_s, nz, source, col, 1);
        } else {
            rows(s_new, ld, N_S, ROW_s, TERM_s, nz, source, col, 0);
            memcpy(s_rows, s_new, sizeof(double) * N_S * ld);
        }
        rows(jac + k * N_Y * ld, ld, N_Y, ROW_y, TERM_y, nz, source, col, 0);
        rows(x_new, ld, N_X, ROW_x, TERM_x, nz, source, col, 0);
        memcpy(x_rows, x_new, sizeof(double) * N_X * ld);
        memcpy(state, next, sizeof(double) * (N_X + N_S));
    }
    return 0;
}
