/* Evaluate a functional mock-up unit for model exchange by direct calls: z = (t, x, u, p) -> derivatives, outputs. */
#include <math.h>
#include <stddef.h>
#include <string.h>

typedef struct {
  int version; /* 2 or 3 */
  void *instance;
  int (*set_time)(void *, double);
  int (*set_states)(void *, const double *, size_t);
  int (*get_derivatives)(void *, double *, size_t);
  void *set_values, *get_values; /* of reals: FMI 3 takes one argument more */
  size_t n_x, n_u, n_p, n_y;
  const unsigned *u_ref, *p_ref, *y_ref;
  double *t, *x, *u, *p, *derivatives, *y, *last_p;
} fmu_t;

typedef int (*set2_t)(void *, const unsigned *, size_t, const double *);
typedef int (*get2_t)(void *, const unsigned *, size_t, double *);
typedef int (*set3_t)(void *, const unsigned *, size_t, const double *, size_t);
typedef int (*get3_t)(void *, const unsigned *, size_t, double *, size_t);

static int set_values(fmu_t *f, const unsigned *ref, size_t n, const double *values) {
  if (!n) return 0;
  return f->version == 2 ? ((set2_t)f->set_values)(f->instance, ref, n, values)
                         : ((set3_t)f->set_values)(f->instance, ref, n, values, n);
}

static int get_values(fmu_t *f, const unsigned *ref, size_t n, double *values) {
  if (!n) return 0;
  return f->version == 2 ? ((get2_t)f->get_values)(f->instance, ref, n, values)
                         : ((get3_t)f->get_values)(f->instance, ref, n, values, n);
}

/* Status 1 is a warning; results of worse ones are no numbers. */
void fmu_evaluate(void *unit) {
  fmu_t *f = unit;
  int worst = f->set_time(f->instance, *f->t), status = 0;
  size_t i;
  if (f->n_p && memcmp(f->p, f->last_p, f->n_p * sizeof(double))) {
    status = set_values(f, f->p_ref, f->n_p, f->p);
    memcpy(f->last_p, f->p, f->n_p * sizeof(double));
  }
  worst = status > worst ? status : worst;
  status = f->n_x ? f->set_states(f->instance, f->x, f->n_x) : 0;
  worst = status > worst ? status : worst;
  status = set_values(f, f->u_ref, f->n_u, f->u);
  worst = status > worst ? status : worst;
  status = f->n_x ? f->get_derivatives(f->instance, f->derivatives, f->n_x) : 0;
  worst = status > worst ? status : worst;
  status = get_values(f, f->y_ref, f->n_y, f->y);
  worst = status > worst ? status : worst;
  if (worst <= 1) return;
  for (i = 0; i < f->n_x; i++) f->derivatives[i] = NAN;
  for (i = 0; i < f->n_y; i++) f->y[i] = NAN;
}
