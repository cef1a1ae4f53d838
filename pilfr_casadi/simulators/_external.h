/* Calls of programs that are not part of the code, by CasADi's function buffers; each thread has its own. */
#include <string.h>

typedef struct {
  void (*evaluate)(void *);
  void *buffer;
  long n_arg, n_res;
  double **arg, **res; /* memory of the buffer */
  const long *arg_size, *res_size;
} external_t;

static _Thread_local const external_t *externals;

void pilfr_bind(const external_t *given) { externals = given; }

static int call_external(int k, const double **arg, double **res) {
  const external_t *e = externals + k;
  long i;
  for (i = 0; i < e->n_arg; i++) {
    if (arg[i])
      memcpy(e->arg[i], arg[i], e->arg_size[i] * sizeof(double));
    else
      memset(e->arg[i], 0, e->arg_size[i] * sizeof(double));
  }
  e->evaluate(e->buffer);
  for (i = 0; i < e->n_res; i++)
    if (res[i]) memcpy(res[i], e->res[i], e->res_size[i] * sizeof(double));
  return 0;
}

