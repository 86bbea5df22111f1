/* The explicit Runge-Kutta method of order 8 of Dormand and Prince with its dense output of order 7 (Hairer, Norsett and Wanner, Solving
   Ordinary Differential Equations I, II.5 and II.6: DOP853), for stretches of a smooth segment that are not stiff.

   Compiled after integrate.c, whose types and functions it uses. Sensitivities are carried through the same stages, which differentiates
   each step exactly. At first, ever more seldom later, and where its steps are as long as stability allows, the method asks for some
   time how long a step of Radau IIA would be; where these would cost less it hands over until the next segment. */

static const double EX_C[16] = {
    0.0, 0.05260015195876773, 0.0789002279381516, 0.1183503419072274, 0.2816496580927726, 0.3333333333333333, 0.25,
     0.3076923076923077, 0.6512820512820513, 0.6, 0.8571428571428571, 1.0, 1.0, 0.1, 0.2, 0.7777777777777778};
static const double EX_A[16][15] = { /* row 12 is the solution's weights */
    {0},
    {0.05260015195876773},
    {0.0197250569845379, 0.0591751709536137},
    {0.02958758547680685, 0, 0.08876275643042054},
    {0.2413651341592667, 0, -0.8845494793282861, 0.924834003261792},
    {0.037037037037037035, 0, 0, 0.17082860872947386, 0.12546768756682242},
    {0.037109375, 0, 0, 0.17025221101954405, 0.06021653898045596, -0.017578125},
    {0.03709200011850479, 0, 0, 0.17038392571223998, 0.10726203044637328, -0.015319437748624402, 0.008273789163814023},
    {0.6241109587160757, 0, 0, -3.3608926294469414, -0.868219346841726, 27.59209969944671, 20.154067550477894,
     -43.48988418106996},
    {0.47766253643826434, 0, 0, -2.4881146199716677, -0.590290826836843, 21.230051448181193, 15.279233632882423,
     -33.28821096898486, -0.020331201708508627},
    {-0.9371424300859873, 0, 0, 5.186372428844064, 1.0914373489967295, -8.149787010746927, -18.52006565999696,
     22.739487099350505, 2.4936055526796523, -3.0467644718982196},
    {2.273310147516538, 0, 0, -10.53449546673725, -2.0008720582248625, -17.9589318631188, 27.94888452941996,
     -2.8589982771350235, -8.87285693353063, 12.360567175794303, 0.6433927460157636},
    {0.054293734116568765, 0, 0, 0, 0, 4.450312892752409, 1.8915178993145003, -5.801203960010585, 0.3111643669578199,
     -0.1521609496625161, 0.20136540080403034, 0.04471061572777259},
    {0.056167502283047954, 0, 0, 0, 0, 0, 0.25350021021662483, -0.2462390374708025, -0.12419142326381637, 0.15329179827876568,
     0.00820105229563469, 0.007567897660545699, -0.008298},
    {0.03183464816350214, 0, 0, 0, 0, 0.028300909672366776, 0.053541988307438566, -0.05492374857139099, 0, 0,
     -0.00010834732869724932, 0.0003825710908356584, -0.00034046500868740456, 0.1413124436746325},
    {-0.42889630158379194, 0, 0, 0, 0, -4.697621415361164, 7.683421196062599, 4.06898981839711, 0.3567271874552811, 0, 0, 0,
     -0.0013990241651590145, 2.9475147891527724, -9.15095847217987}};
static const double EX_E3[12] = {
    -0.18980075407240762, 0, 0, 0, 0, 4.450312892752409, 1.8915178993145003, -5.801203960010585, -0.4226823213237919,
     -0.1521609496625161, 0.20136540080403034, 0.02265179219836082};
static const double EX_E5[12] = {
    0.01312004499419488, 0, 0, 0, 0, -1.2251564463762044, -0.4957589496572502, 1.6643771824549864, -0.35032884874997366,
     0.3341791187130175, 0.08192320648511571, -0.022355307863886294};
static const double EX_D[4][16] = {
    {-8.428938276109013, 0, 0, 0, 0, 0.5667149535193777, -3.0689499459498917, 2.38466765651207, 2.117034582445028,
     -0.871391583777973, 2.2404374302607883, 0.6315787787694688, -0.08899033645133331, 18.148505520854727, -9.194632392478356,
     -4.436036387594894},
    {10.427508642579134, 0, 0, 0, 0, 242.28349177525817, 165.20045171727028, -374.5467547226902, -22.113666853125306,
     7.733432668472264, -30.674084731089398, -9.332130526430229, 15.697238121770845, -31.139403219565178, -9.35292435884448,
     35.81684148639408},
    {19.985053242002433, 0, 0, 0, 0, -387.0373087493518, -189.17813819516758, 527.8081592054236, -11.57390253995963,
     6.8812326946963, -1.0006050966910838, 0.7777137798053443, -2.778205752353508, -60.19669523126412, 84.32040550667716,
     11.99229113618279},
    {-25.69393346270375, 0, 0, 0, 0, -154.18974869023643, -231.5293791760455, 357.6391179106141, 93.40532418362432,
     -37.45832313645163, 104.0996495089623, 29.8402934266605, -43.53345659001114, 96.32455395918828, -39.17726167561544,
     -149.72683625798564}};

#define EX_SHARE 0.03                       /* of the bound on the states: an estimate this small leaves errors like those of radau.c */
#define STIFF 4.0                           /* h times the rate at which the last two stages part; the method is stable up to about 6 */
#define STIFF_STEPS 6                       /* so many in a row ask for Radau's steps, later ever more */
#define UNSTABLE 6.0                        /* a step beyond this is not taken */
#define EACH 4                              /* of so many steps one is compared with Radau's, */
#define SAMPLES 16                          /* so often before it is decided, over a period of the load at least: LONGEST times `longest` */
#define LONGEST 4.0
#define CLEARLY 4.0                         /* so many times dearer than Radau it is decided at once: at rest a period would take for ever */
#define STEEPENING 5.0                      /* of the Jacobian within a step: hands over */
#define DAMAGED 12                          /* so many rejected steps in a row, too */
#define DEARER 1.5                          /* a step of Radau, times one of this method */

/* x at a stage, and the slopes of x and S there into k and K */
static void ex_slopes(const History *q, Imposed *force, double t, const double *x, const double *S, double *k, double *K) {
    double V, W, W_dot;
    imposed(force, t, &V, &W, &W_dot);
    memset(k, 0, NX * sizeof(double));
    srf_rates(x, V, W, W_dot, force->p, k);
    if (!q->ns) return;
    double J[NX * NX], P[NX * NP];
    memset(J, 0, sizeof J);
    memset(P, 0, sizeof P);
    srf_jacobian(x, V, W, W_dot, force->p, J);
    srf_parameters(x, V, W, W_dot, force->p, P);
    for (int r = 0; r < NX; r++) {
        double *out = K + (size_t)r * q->ns;
        for (int c = 0; c < q->ns; c++) out[c] = q->which[c] >= 0 ? P[r * NP + q->which[c]] : 0.0;
        for (int i = 0; i < NX; i++) {
            double j = J[r * NX + i];
            const double *from = S + (size_t)i * q->ns;
            if (j != 0.0)
                for (int c = 0; c < q->ns; c++) out[c] += j * from[c];
        }
    }
}

/* out = from + h sum of weights[i] k[i], i < count, of vectors of n */
static void ex_sum(int n, int count, const double *weights, double h, const double *from, const double *k, double *out) {
    memcpy(out, from, n * sizeof(double));
    for (int i = 0; i < count; i++) {
        double a = h * weights[i];
        if (a != 0.0)
            for (int j = 0; j < n; j++) out[j] += a * k[(size_t)i * n + j];
    }
}

/* the norm of the estimates of order 5 and 3 of one column of n values: components `stride` apart, bounded by `bound` */
static double ex_error(int stride, const double *k, size_t size, const double *bound, double h) {
    double five = 0.0, three = 0.0;
    for (int r = 0; r < NX; r++) {
        double e5 = 0.0, e3 = 0.0;
        for (int i = 0; i < 12; i++) {
            e5 += EX_E5[i] * k[i * size + (size_t)r * stride];
            e3 += EX_E3[i] * k[i * size + (size_t)r * stride];
        }
        five += (e5 / bound[r]) * (e5 / bound[r]);
        three += (e3 / bound[r]) * (e3 / bound[r]);
    }
    if (five == 0.0 && three == 0.0) return 0.0;
    return fabs(h) * five / sqrt((five + 0.01 * three) * NX);
}

/* the polynomial over a step at the share s of it; coefficients as Hairer's contd8 */
static void ex_dense(int n, const double *from, const double *to, double h, const double *k, double s, double *out) {
    double one = 1.0 - s;
    for (int j = 0; j < n; j++) {
        double change = to[j] - from[j], first = h * k[j] - change, second = change - h * k[(size_t)12 * n + j] - first, c[4];
        for (int d = 0; d < 4; d++) {
            double sum = 0.0;
            for (int i = 0; i < 16; i++)
                if (EX_D[d][i] != 0.0) sum += EX_D[d][i] * k[(size_t)i * n + j];
            c[d] = h * sum;
        }
        out[j] = from[j] + s * (change + one * (first + s * (second + one * (c[0] + s * (c[1] + one * (c[2] + s * c[3]))))));
    }
}

/* the largest entry of the Jacobian: within a slider that stops it grows as 1/v */
static double ex_steepness(Imposed *force, double t, const double *x) {
    double J[NX * NX], largest = DBL_MIN;
    jacobian_at(force, t, x, J);
    for (int i = 0; i < NX * NX; i++) largest = fmax(largest, fabs(J[i]));
    return finite_all(J, NX * NX) ? largest : INFINITY;
}

/* Integrates from the only node towards b and leaves that node where it ended, at b or where the motion is stiff; returns the next
   output index, or -1 - (it) where it was stopped. */
static int explicit_steps(Imposed *force, History *q, double b, double rtol, const double *atol, double longest, long max_steps,
                          int next, int nt, const double *t, double *X, double *S, double *stats, const volatile int *stop) {
    Node *now = &q->node[0];
    const int ns = q->ns, wide = NX * ns;
    double k[16][NX], x[NX], stage[NX], bound[NX], own_rtol = EX_SHARE * pow(10.0 * rtol, 1.5);
    double share = own_rtol / rtol, *K = q->explicit_work, *S_stage = K + (size_t)16 * wide, *S_after = S_stage + wide;
    int rejected = 0, stiff = 0, patience = STIFF_STEPS, asked = 0;
    long taken = 0, ask = 0, pause = EACH * SAMPLES;
    double cost = 0.0, since = now->t; /* of the asked steps by Radau, in steps of this method */
    double carry = 0.0, steep = ex_steepness(force, now->t, now->x);
    ex_slopes(q, force, now->t, now->x, q->S, k[0], K);
    double h = fmin(first_step(force, now, b - now->t, own_rtol, atol), longest);
    while (now->t < b) {
        if (*stop || stats[0] + stats[1] >= max_steps) return -1 - next;
        int final = fitted(&h, b - now->t);
        if (h < 64.0 * DBL_EPSILON * fmax(fabs(now->t), fabs(b)) && !final) break;
        for (int i = 1; i < 12; i++) {
            ex_sum(NX, i, EX_A[i], h, now->x, k[0], stage);
            if (ns) ex_sum(wide, i, EX_A[i], h, q->S, K, S_stage);
            ex_slopes(q, force, now->t + EX_C[i] * h, stage, S_stage, k[i], K + (size_t)i * wide);
        }
        ex_sum(NX, 12, EX_A[12], h, now->x, k[0], x);
        if (ns) ex_sum(wide, 12, EX_A[12], h, q->S, K, S_after);
        for (int r = 0; r < NX; r++) bound[r] = share * atol[r] + own_rtol * fmax(fabs(now->x[r]), fabs(x[r]));
        double error = ex_error(1, k[0], NX, bound, h);
        for (int c = 0; c < ns && error < 1.0; c++) {
            for (int r = 0; r < NX; r++) {
                double most = fmax(fabs(q->S[(size_t)r * ns + c]), fabs(S_after[(size_t)r * ns + c]));
                bound[r] = SHARE * (share * atol[r] * q->scale[c] + own_rtol * most);
            }
            error = fmax(error, ex_error(ns, K + c, wide, bound, h));
        }
        if (error < 1.0) ex_slopes(q, force, now->t + h, x, S_after, k[12], K + (size_t)12 * wide);
        int sound = isfinite(error) && finite_all(x, NX) && (error >= 1.0 || (finite_all(k[12], NX) && (!ns || finite_all(S_after, wide))));
        if (!sound || error >= 1.0) {
            stats[1] += 1;
            h *= sound ? fmax(0.333, 0.9 * pow(error, -0.125)) : 0.25;
            if (++rejected > DAMAGED) break;
            continue;
        }
        double parted = 0.0, apart = 0.0;     /* how fast the slopes at the step's end and at its last stage part */
        for (int r = 0; r < NX; r++) {
            parted += (k[12][r] - k[11][r]) * (k[12][r] - k[11][r]);
            apart += (x[r] - stage[r]) * (x[r] - stage[r]);
        }
        double stiffness = apart > 0.0 ? h * sqrt(parted / apart) : 0.0;
        double steep_after = ex_steepness(force, now->t + h, x);
        /* such a step is taken again, implicitly or shorter: what lies within it is not to be relied on */
        if (!(steep_after < STEEPENING * steep)) break;
        if (stiffness > UNSTABLE) {
            stats[1] += 1;
            h *= STIFF / stiffness;
            if (++rejected > DAMAGED) break;
            continue;
        }
        steep = steep_after;
        stiff = stiffness > STIFF ? stiff + 1 : 0;
        stats[0] += 1;
        double after = time_after(now->t, h, b, final, &carry);
        if (next < nt && t[next] <= after) {
            for (int i = 13; i < 16; i++) {
                ex_sum(NX, i, EX_A[i], h, now->x, k[0], stage);
                if (ns) ex_sum(wide, i, EX_A[i], h, q->S, K, S_stage);
                ex_slopes(q, force, now->t + EX_C[i] * h, stage, S_stage, k[i], K + (size_t)i * wide);
            }
            for (; next < nt && t[next] <= after; next++) {
                double s = fmin((t[next] - now->t) / h, 1.0);
                ex_dense(NX, now->x, x, h, k[0], s, X + (size_t)next * NX);
                if (ns) ex_dense(wide, q->S, S_after, h, K, s, S + (size_t)next * wide);
            }
        }
        now->t = after;
        memcpy(now->x, x, sizeof x);
        memcpy(k[0], k[12], sizeof k[0]);
        if (ns) {
            memcpy(q->S, S_after, wide * sizeof(double));
            memcpy(K, K + (size_t)12 * wide, wide * sizeof(double));
        }
        memcpy(now->f, k[0], sizeof now->f);
        if (stiff >= patience && taken < ask) {
            ask = taken;
            patience *= 2;
        }
        if (taken++ >= ask && (taken - ask) % EACH == 0) {
            double tried = fmin(h, b - now->t);
            since = asked ? since : now->t;
            cost += DEARER * tried / fmax(implicit_reach(force, now, tried, rtol, atol), DBL_MIN);
            if (++asked >= SAMPLES && cost < asked / CLEARLY) break;
            if (asked >= SAMPLES && (now->t - since >= LONGEST * longest || LONGEST * longest > b - now->t)) {
                if (cost < asked) break;
                ask = taken + pause;
                pause *= 2;
                asked = 0;
                cost = 0.0;
            }
        }
        double growth = error > 0.0 ? 0.9 * pow(error, -0.125) : 6.0;
        h = fmin(h * fmin(rejected ? 1.0 : 6.0, fmax(0.333, growth)), longest);
        rejected = 0;
    }
    return next;
}
