/* What the time loops of _kernel.c need to know of a generated model.
 *
 * The values of one sample lie in one stack: constants first, then p, what depends on p alone, u, x, s, z, w, c and what
 * has to be computed, from at_p, at_fixed, ... on. A row of slopes is a sum of terms: term[row[i]] .. term[row[i+1]] are those
 * of row i of a target, each {source, index, value}: the row `index` of source 0 x, 1 s, 2 z, 3 w, times a value of the
 * stack; direct likewise {parameter, value}: the value goes to the parameter's column.
 *
 * A step of several stages has `slopes` instead of tables: it advances the slopes of x and s, which may be the same as s_next,
 * and gives those of y unless it is null. What depends on a parameter directly is {row, parameter, value}: the value stands in
 * that row of `direct`, in the parameter's column.
 */
#if defined(__AVX512F__)
#define WIDTH 8 /* numbers in one register */
#elif defined(__AVX__)
#define WIDTH 4
#else
#define WIDTH 2
#endif
typedef double lane_t __attribute__((vector_size(sizeof(double) * WIDTH), aligned(8), may_alias));
#define AT(rows, i) (*(lane_t *)((rows) + (i) * ld + j))
#define NONE ((lane_t){0})
#if defined(__GNUC__) && !defined(__clang__)
#define OPTIMISED __attribute__((optimize("O2"))) /* else wide registers are left dirty, and all that follows is slow */
#else
#define OPTIMISED
#endif
typedef struct { int row, parameter, value; } entered_t;
typedef struct { int source, index, value; } term_t;
typedef struct { int parameter, value; } direct_t;
typedef struct { const int *row; const term_t *term; const int *direct_row; const direct_t *direct; } table_t;
typedef int (*generated_t)(const double **arg, double **res, long long *iw, double *w, int memory);
typedef struct {
    generated_t fixed, step, computed;
    const double *constants;
    table_t of_x, of_s, of_z, of_w, of_y;
    void (*slopes)(const double *v, const double *x, const double *s, const double *direct, double *s_next, double *x_next,
                   double *y, long ld);
    const entered_t *direct;
    int n_direct, n_direct_rows, at_c;
    int n_x, n_s, n_z, n_y, n_u, n_p, n_fixed, n_values, n_terms, stride, keeps;
    int at_p, at_fixed, at_u, at_x, at_s, at_z, at_w, at_computed;
    long sz_w;
} model_t;
