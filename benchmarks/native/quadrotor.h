/* The quadrotor of benchmarks/systems.py: its step, the entries of its Jacobian that are not zero, and its filters. */

#define QUAD_DT ((REAL)0.01)
#define GRAVITY ((REAL)9.81)
#define JX ((REAL)0.010)
#define JY ((REAL)0.012)
#define JZ ((REAL)0.020)

enum { ENTRIES = 52 };

/* F - I, row by row: row i has the entries BEGINS[i] ... BEGINS[i + 1] - 1, in these columns */
static const int BEGINS[13] = {0, 6, 12, 17, 22, 25, 29, 34, 40, 46, 48, 50, 52};
static const int COLUMN[ENTRIES] = {
    3, 4, 5, 6, 7, 8,
    3, 4, 5, 6, 7, 8,
    3, 4, 6, 7, 8,
    3, 4, 9, 10, 11,
    3, 10, 11,
    3, 4, 10, 11,
    4, 7, 8, 10, 11,
    3, 4, 6, 8, 9, 11,
    3, 4, 6, 7, 9, 10,
    10, 11,
    9, 11,
    9, 10,
};
static const int SEEN[9] = {0, 1, 2, 3, 4, 5, 9, 10, 11};

/* moves x; a: the entries of F - I */
INLINE void quadrotor_moved(V *x, V *a, const REAL *u)
{
    const REAL dt = QUAD_DT, k0 = (JY - JZ) / JX, k1 = (JZ - JX) / JY, k2 = (JX - JY) / JZ;
    V sf = lane_sin(x[3]), cf = lane_cos(x[3]), st = lane_sin(x[4]), ct = lane_cos(x[4]);
    V sp = lane_sin(x[5]), cp = lane_cos(x[5]);
    V v0 = x[6], v1 = x[7], v2 = x[8], w0 = x[9], w1 = x[10], w2 = x[11];
    V r00 = ct * cp, r01 = sf * st * cp - cf * sp, r02 = cf * st * cp + sf * sp;
    V r10 = ct * sp, r11 = sf * st * sp + cf * cp, r12 = cf * st * sp - sf * cp;
    V r20 = -st, r21 = sf * ct, r22 = cf * ct, sec = 1 / ct, tan = st * sec;
    V vx = r00 * v0 + r01 * v1 + r02 * v2, vy = r10 * v0 + r11 * v1 + r12 * v2, vz = r20 * v0 + r21 * v1 + r22 * v2;
    V turn = sf * w1 + cf * w2, lean = cf * w1 - sf * w2;
    V F[ENTRIES] = {
        r02 * v1 - r01 * v2, cp * vz, -vy, r00, r01, r02,
        r12 * v1 - r11 * v2, sp * vz, vx, r10, r11, r12,
        r22 * v1 - r21 * v2, -ct * v0 - st * (sf * v1 + cf * v2), r20, r21, r22,
        tan * lean, turn * sec * sec, all(1), tan * sf, tan * cf,
        -turn, cf, -sf,
        lean * sec, turn * tan * sec, sf * sec, cf * sec,
        GRAVITY * ct, w2, -w1, -v2, v1,
        -GRAVITY * r22, GRAVITY * sf * st, -w2, w0, v2, -v0,
        GRAVITY * r21, GRAVITY * cf * st, w1, -w0, -v1, v0,
        k0 * w2, k0 * w1, k1 * w2, k1 * w0, k2 * w1, k2 * w0,
    };
    UNROLL for (int e = 0; e < ENTRIES; e++) a[e] = dt * F[e];
    x[0] += dt * vx, x[1] += dt * vy, x[2] += dt * vz;
    x[3] += dt * (w0 + tan * turn), x[4] += dt * lean, x[5] += dt * (turn * sec);
    x[6] += dt * (w2 * v1 - w1 * v2 + GRAVITY * st);
    x[7] += dt * (w0 * v2 - w2 * v0 - GRAVITY * r21);
    x[8] += dt * (w1 * v0 - w0 * v1 - GRAVITY * r22 + u[0]);
    x[9] += dt * (k0 * w1 * w2 + u[1] / JX);
    x[10] += dt * (k1 * w0 * w2 + u[2] / JY);
    x[11] += dt * (k2 * w0 * w1 + u[3] / JZ);
}

static void quadrotor(const Args *g, int b)
{
    BEGIN(12, 9);
    V P[78], a[ENTRIES], A[12][12];
    memcpy(P, P0, sizeof P);
    for (int t = 0; t < g->steps; t++) {
        quadrotor_moved(x, a, g->u + 4 * t);
        UNROLL for (int i = 0; i < n; i++)
            UNROLL for (int j = 0; j < n; j++) {
                A[i][j] = P[ID(i, j)];
                UNROLL for (int e = BEGINS[i]; e < BEGINS[i + 1]; e++) A[i][j] += a[e] * P[ID(COLUMN[e], j)];
            }
        UNROLL for (int i = 0; i < n; i++)
            UNROLL for (int j = 0; j <= i; j++) {
                V sum = A[i][j];
                UNROLL for (int e = BEGINS[j]; e < BEGINS[j + 1]; e++) sum += a[e] * A[i][COLUMN[e]];
                P[ID(i, j)] = i == j ? sum + g->Q[i * 13] : sum;
            }
        UNROLL for (int s = 0; s < m; s++) update_one(n, SEEN[s], x, P, g->R[s * 10], Z(s));
        STORE(ID(i, i));
    }
}

static void quadrotor_dense(const Args *g, int b)
{
    BEGIN(12, 9);
    V P[144], F[144], a[ENTRIES], r[9];
    unpacked(n, P0, P);
    for (int i = 0; i < 144; i++) F[i] = all(0);
    for (int t = 0; t < g->steps; t++) {
        quadrotor_moved(x, a, g->u + 4 * t);
        for (int i = 0; i < n; i++) {
            F[i * n + i] = all(1);
            for (int e = BEGINS[i]; e < BEGINS[i + 1]; e++) F[i * n + COLUMN[e]] = COLUMN[e] == i ? 1 + a[e] : a[e];
        }
        predict_dense(n, P, F, g->Q);
        for (int s = 0; s < m; s++) r[s] = Z(s) - x[SEEN[s]];
        update_dense(n, m, x, P, g->H, g->R, r);
        STORE(i * n + i);
    }
}
