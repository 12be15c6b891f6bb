/* Real-time iteration for the NMPC: linearise every stage at the stored trajectory, solve one
 * structured QP with HPIPM, take the full step. The stage functions stage() and terminal() are
 * generated from the robot's model and precede this file in the same translation unit.
 *
 * All matrices are column-major, as CasADi generates and HPIPM reads them. */
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <blasfeo_d_aux_ext_dep.h>
#include <hpipm_d_ocp_qp.h>
#include <hpipm_d_ocp_qp_dim.h>
#include <hpipm_d_ocp_qp_ipm.h>
#include <hpipm_d_ocp_qp_sol.h>

#define NU 8
#define NREF 29
#define NT 4                            /* tilts, states TILT to TILT + 3 and inputs 0 to 3 */
#define TILT 13
#define OFFSET 6                        /* of the servos' offsets in the disturbance */
#define NBX 7                           /* bounded states: height, velocity, body rate */
#define HEIGHT 2
#define MAX_STAGES 64

static const int bounded_state[NBX] = {HEIGHT, 3, 4, 5, 10, 11, 12};

struct rti {
    int horizon, nx, soft;          /* intervals, states, whether states are softly bounded */
    int reaches;                    /* intervals beyond the first with a bounded command lead */
    double interval[MAX_STAGES];    /* length of each interval [s] */
    double *x, *u;                  /* stored trajectory (N+1) x nx, N x NU */
    double *x_saved, *u_saved;
    struct d_ocp_qp_dim dim;
    struct d_ocp_qp qp;
    struct d_ocp_qp_sol sol;
    struct d_ocp_qp_ipm_arg arg;
    struct d_ocp_qp_ipm_ws ws;
    int status, iterations;
    void *blocks[8];
    int block_count;
};

static void *block(struct rti *s, size_t size)
{
    void *memory = NULL;
    size = (size + 127) / 64 * 64;
    if (posix_memalign(&memory, 64, size)) return NULL;
    memset(memory, 0, size);
    s->blocks[s->block_count++] = memory;
    return memory;
}

void rti_free(struct rti *s)
{
    if (!s) return;
    for (int i = 0; i < s->block_count; i++) free(s->blocks[i]);
    free(s);
}

/* soft_weights: linear weight of the slacks, quadratic on v and w, quadratic on the height. The
 * linear one is common: HPIPM needs more iterations if the multipliers differ in scale.
 * reaches: intervals beyond the first in which tilt targets keep within reach of the tilts. */
struct rti *rti_create(int horizon, const double *interval, int nx, int soft,
                       const double *soft_weights, double tolerance, int max_iterations, int reaches)
{
    if (horizon < 1 || horizon > MAX_STAGES) return NULL;
    struct rti *s = calloc(1, sizeof(struct rti));
    if (!s) return NULL;
    s->horizon = horizon, s->nx = nx, s->soft = soft, s->reaches = reaches;
    memcpy(s->interval, interval, horizon * sizeof(double));
    s->x = block(s, 2 * (horizon + 1) * nx * sizeof(double));
    s->u = block(s, 2 * horizon * NU * sizeof(double));
    if (!s->x || !s->u) { rti_free(s); return NULL; }
    s->x_saved = s->x + (horizon + 1) * nx;
    s->u_saved = s->u + horizon * NU;

    void *memory = block(s, d_ocp_qp_dim_memsize(horizon));
    d_ocp_qp_dim_create(horizon, &s->dim, memory);
    for (int k = 0; k <= horizon; k++) {
        int bounded = k > 0 ? NBX : 0;  /* the first state is given */
        d_ocp_qp_dim_set_nx(k, k > 0 ? nx : 0, &s->dim);
        d_ocp_qp_dim_set_nu(k, k < horizon ? NU : 0, &s->dim);
        d_ocp_qp_dim_set_nbx(k, bounded, &s->dim);
        d_ocp_qp_dim_set_nbu(k, k < horizon ? NU : 0, &s->dim);
        d_ocp_qp_dim_set_ng(k, k > 0 && k <= reaches ? NT : 0, &s->dim);
        d_ocp_qp_dim_set_ns(k, soft ? bounded : 0, &s->dim);
    }
    d_ocp_qp_create(&s->dim, &s->qp, block(s, d_ocp_qp_memsize(&s->dim)));
    d_ocp_qp_sol_create(&s->dim, &s->sol, block(s, d_ocp_qp_sol_memsize(&s->dim)));
    d_ocp_qp_ipm_arg_create(&s->dim, &s->arg, block(s, d_ocp_qp_ipm_arg_memsize(&s->dim)));
    d_ocp_qp_ipm_arg_set_default(SPEED, &s->arg);
    d_ocp_qp_ipm_arg_set_iter_max(&max_iterations, &s->arg);
    d_ocp_qp_ipm_arg_set_tol_stat(&tolerance, &s->arg);
    d_ocp_qp_ipm_arg_set_tol_eq(&tolerance, &s->arg);
    d_ocp_qp_ipm_arg_set_tol_ineq(&tolerance, &s->arg);
    d_ocp_qp_ipm_arg_set_tol_comp(&tolerance, &s->arg);
    d_ocp_qp_ipm_ws_create(&s->dim, &s->arg, &s->ws,
                           block(s, d_ocp_qp_ipm_ws_memsize(&s->dim, &s->arg)));

    int input_index[NU], state_index[NBX], slack_index[NBX];
    double zero[NBX] = {0}, linear[NBX], quadratic[NBX], C[NT * 21] = {0}, D[NT * NU] = {0};
    double no_upper[NBX] = {0, 1, 1, 1, 1, 1, 1};           /* the height has no upper bound */
    for (int i = 0; i < NT; i++) C[(TILT + i) * NT + i] = -1, D[i * NT + i] = 1;
    for (int i = 0; i < NU; i++) input_index[i] = i;
    for (int i = 0; i < NBX; i++) {
        state_index[i] = bounded_state[i];
        linear[i] = soft_weights[0], quadratic[i] = soft_weights[i == 0 ? 2 : 1];
    }
    for (int k = 0; k <= horizon; k++) {
        if (k < horizon) d_ocp_qp_set_idxbu(k, input_index, &s->qp);
        if (k == 0) continue;
        if (k <= reaches) d_ocp_qp_set_C(k, C, &s->qp), d_ocp_qp_set_D(k, D, &s->qp);
        d_ocp_qp_set_idxbx(k, state_index, &s->qp);
        d_ocp_qp_set_ubx_mask(k, no_upper, &s->qp);
        if (!soft) continue;
        for (int i = 0; i < NBX; i++) slack_index[i] = i + (k < horizon ? NU : 0);   /* bu, bx, g */
        d_ocp_qp_set_idxs(k, slack_index, &s->qp);
        d_ocp_qp_set_Zl(k, quadratic, &s->qp), d_ocp_qp_set_Zu(k, quadratic, &s->qp);
        d_ocp_qp_set_zl(k, linear, &s->qp), d_ocp_qp_set_zu(k, linear, &s->qp);
        d_ocp_qp_set_lls(k, zero, &s->qp), d_ocp_qp_set_lus(k, zero, &s->qp);
    }
    return s;
}

/* Move the stored trajectory forward by a time no longer than the shortest interval. */
void rti_shift(struct rti *s, double time)
{
    int nx = s->nx;
    for (int k = 0; k < s->horizon; k++) {
        double part = time / s->interval[k];
        for (int i = 0; i < nx; i++)
            s->x[k * nx + i] += part * (s->x[(k + 1) * nx + i] - s->x[k * nx + i]);
    }
    for (int k = 0; k + 1 < s->horizon; k++) {
        double part = time / s->interval[k];
        for (int i = 0; i < NU; i++)
            s->u[k * NU + i] += part * (s->u[(k + 1) * NU + i] - s->u[k * NU + i]);
    }
}

static int finite_all(const double *values, int count)
{
    for (int i = 0; i < count; i++) if (!isfinite(values[i])) return 0;
    return 1;
}

/* One iteration. references: (N+1) x NREF; disturbance: 10; bounds: lower u (NU), upper u (NU),
 * limit of |v| and |w| by component, reach of the tilt targets (N), smallest height at the nodes
 * 1 to N. Returns the QP status: 0 solved, 1 iteration limit, 2 step length, 3 NaN; on 2 and 3 the
 * stored trajectory stays as it was. */
int rti_step(struct rti *s, const double *x0, const double *references, const double *disturbance,
             const double *weights, const double *bounds)
{
    const int nx = s->nx, N = s->horizon;
    double f[21], A[21 * 21], B[21 * NU], Q[21 * 21], R[NU * NU], S[NU * 21], q[21], r[NU], b[21];
    double lower[NU], upper[NU];
    const double *arg[6];
    double *res[8] = {f, A, B, Q, R, S, q, r};
    double *x = s->x, *u = s->u;

    memcpy(s->x_saved, x, (N + 1) * nx * sizeof(double));
    memcpy(s->u_saved, u, N * NU * sizeof(double));
    /* q and -q are one attitude: keep the stored horizon on the side of the measured one. */
    double dot = 0;
    for (int i = 6; i < 10; i++) dot += x0[i] * x[i];
    if (dot < 0)
        for (int k = 0; k <= N; k++) for (int i = 6; i < 10; i++) x[k * nx + i] *= -1;
    memcpy(x, x0, nx * sizeof(double));

    for (int k = 0; k < N; k++) {
        arg[0] = x + k * nx, arg[1] = u + k * NU, arg[2] = disturbance;
        arg[3] = references + k * NREF, arg[4] = weights, arg[5] = s->interval + k;
        stage(arg, res, 0, 0, 0);
        for (int i = 0; i < nx; i++) b[i] = f[i] - x[(k + 1) * nx + i];
        d_ocp_qp_set_B(k, B, &s->qp), d_ocp_qp_set_b(k, b, &s->qp);
        d_ocp_qp_set_R(k, R, &s->qp), d_ocp_qp_set_r(k, r, &s->qp);
        if (k > 0) {
            d_ocp_qp_set_A(k, A, &s->qp), d_ocp_qp_set_Q(k, Q, &s->qp);
            d_ocp_qp_set_S(k, S, &s->qp), d_ocp_qp_set_q(k, q, &s->qp);
        }
        for (int i = 0; i < NU; i++)
            lower[i] = bounds[i] - u[k * NU + i], upper[i] = bounds[NU + i] - u[k * NU + i];
        if (k <= s->reaches) {
            double reach = bounds[2 * NU + 2 + k], low[NT], high[NT];
            for (int i = 0; i < NT; i++) {
                double lead = u[k * NU + i] + disturbance[OFFSET + i] - x[k * nx + TILT + i];
                low[i] = -reach - lead, high[i] = reach - lead;
                if (k > 0) continue;        /* the first state is given: a bound on the input */
                double bottom = lower[i], top = upper[i];
                lower[i] = fmin(fmax(low[i], bottom), top), upper[i] = fmax(fmin(high[i], top), bottom);
            }
            if (k > 0) d_ocp_qp_set_lg(k, low, &s->qp), d_ocp_qp_set_ug(k, high, &s->qp);
        }
        d_ocp_qp_set_lbu(k, lower, &s->qp), d_ocp_qp_set_ubu(k, upper, &s->qp);
    }
    arg[0] = x + N * nx, arg[1] = references + N * NREF, arg[2] = weights;
    res[0] = Q, res[1] = q;
    terminal(arg, res, 0, 0, 0);
    d_ocp_qp_set_Q(N, Q, &s->qp), d_ocp_qp_set_q(N, q, &s->qp);
    for (int k = 1; k <= N; k++) {
        lower[0] = bounds[2 * NU + 2 + N + k - 1] - x[k * nx + HEIGHT], upper[0] = 0;
        for (int i = 1; i < NBX; i++) {
            double limit = bounds[2 * NU + (i - 1) / 3], value = x[k * nx + bounded_state[i]];
            lower[i] = -limit - value, upper[i] = limit - value;
        }
        d_ocp_qp_set_lbx(k, lower, &s->qp), d_ocp_qp_set_ubx(k, upper, &s->qp);
    }

    d_ocp_qp_ipm_solve(&s->qp, &s->sol, &s->arg, &s->ws);
    d_ocp_qp_ipm_get_status(&s->ws, &s->status);
    d_ocp_qp_ipm_get_iter(&s->ws, &s->iterations);
    for (int k = 0; k < N; k++) {
        d_ocp_qp_sol_get_u(k, &s->sol, r);
        for (int i = 0; i < NU; i++) u[k * NU + i] += r[i];
        d_ocp_qp_sol_get_x(k + 1, &s->sol, q);
        for (int i = 0; i < nx; i++) x[(k + 1) * nx + i] += q[i];
    }
    if (!finite_all(x, (N + 1) * nx) || !finite_all(u, N * NU)) s->status = 3;
    if (s->status > 1) {
        memcpy(x, s->x_saved, (N + 1) * nx * sizeof(double));
        memcpy(u, s->u_saved, N * NU * sizeof(double));
    }
    return s->status;
}

int rti_iterations(const struct rti *s) { return s->iterations; }
double *rti_states(struct rti *s) { return s->x; }
double *rti_inputs(struct rti *s) { return s->u; }
