#include "{{ name }}.h"

{{ code }}
void {{ name }}_x0(double *x) {
{% for value in x0 %}
  x[{{ loop.index0 }}] = {{ value }};
{% else %}
  (void)x;
{% endfor %}
}

void {{ name }}_step(const double *x, const double *u, double *x_next, double *y) {
  const casadi_real *arg[{{ [1, function.sz_arg()] | max }}];
  casadi_real *res[{{ [1, function.sz_res()] | max }}];
  casadi_int iw[{{ [1, function.sz_iw()] | max }}];
  casadi_real w[{{ [1, function.sz_w()] | max }}];
  double now[{{ [1, x0 | length] | max }}]; /* x_next may be x */
  int i;
{% if x0 %}
  for (i = 0; i < {{ big }}_NX; i++) now[i] = x[i];
{% else %}
  (void)x; i = 0; now[i] = 0;
{% endif %}
  arg[0] = now;
  arg[1] = u;
  res[0] = x_next;
  res[1] = y;
  {{ function.name() }}(arg, res, iw, w, 0);
}
